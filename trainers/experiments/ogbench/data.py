"""Recorded episodes: made as OGBench makes them, or read from its files.

Letters: T recorded steps.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.envs import shortest_path_lengths
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.trainers.experiments.ogbench.config import Recipe, split_name
from torchrl_hmcts.trainers.saving.files import replacing

Cell = tuple[int, int]
_SIDES = ((-1, 0), (0, -1), (1, 0), (0, 1))


@contextmanager
def quiet() -> Iterator[None]:
    """Hide that OGBench's arms make a space of float64, each time that they are asked for it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*precision lowered by casting")
        yield


@quiet()
def record(
    name: str,
    *,
    seed: int = 0,
    episodes: int = 0,
    walker: str | Path = "",
    progress: Callable[[Any], Any] = iter,
) -> TensorDict:
    """Record a dataset as OGBench's script does; its draws are other ones.

    A maze's episode begins in a cell that is drawn from all. The point or ant walks to the centre
    of the next cell on the shortest way to a goal, with noise on every action. ``"navigate"`` draws
    a new goal among crossings, corners and dead ends wherever one is reached; ``"stitch"`` has one
    goal, four cells away; ``"explore"`` has a drawn direction, for ten steps each. In a puzzle the
    arm presses one drawn button after another and moves to a drawn place in between, on a noisy
    path; what the buttons show at first is drawn.

    Args:
        name: of the dataset.
        seed: of all draws.
        episodes: number of them. Default 0: as many as OGBench records for training.
        walker: of ant mazes, the folder of a worker of the kit ``ant``: OGBench's own expert, a
            policy that SAC trained, is not in its package.
        progress: wraps the range of the episodes, e.g. ``tqdm``.

    Returns:
        ``"observation"`` and ``"action"``, float32 ``[T, ...]``, and ``"done"``, bool ``[T, 1]``:
        the episode's last step.

    Raises:
        ValueError: if the name is unknown, a number is negative, or an ant has no walker.
    """
    whole_number("record", "seed", seed, least=0)
    whole_number("record", "episodes", episodes, least=0)
    recipe = split_name(name)
    if recipe.is_ant and not walker:
        raise ValueError(
            f"{name} needs an ant that can walk. Train one (hmcts train kit=ant "
            f"env.id=antmaze-large-v0 out=DIR, five minutes), then: hmcts data id={name} walker=DIR"
        )
    mode = {"mode": "data_collection"} if recipe.kind == "play" else {}
    env = make_gym(recipe.env, terminate_at_goal=False, max_episode_steps=recipe.steps, **mode)
    env.action_space.seed(seed)
    first, _ = env.reset(seed=seed)  # the draws of NumPy's global generator too
    count = episodes or recipe.episodes
    most = count * recipe.steps
    observations = np.empty((most, *first.shape), np.float32)
    actions = np.empty((most, *env.action_space.shape), np.float32)
    ends, at = np.zeros((most, 1), np.bool_), 0
    with env:  # its draws, for all episodes
        oracle: _Walks | _Presses = (
            _Presses(env.unwrapped, recipe)
            if recipe.kind == "play"
            else _Walks(env.unwrapped, recipe, np.random.default_rng(seed), walker)
        )
        for _ in progress(range(count)):
            for observation, action in oracle.episode(env):
                observations[at], actions[at] = observation, action
                at += 1
            ends[at - 1] = True
    parts = {"observation": observations, "action": actions, "done": ends}
    return TensorDict({k: torch.from_numpy(v[:at]) for k, v in parts.items()}, [at])


class _Walks:
    """Walks from cell to cell towards a goal."""

    def __init__(
        self, env: Any, recipe: Recipe, draws: np.random.Generator, walker: str | Path
    ) -> None:
        self.env, self.recipe, self.draws = env, recipe, draws
        free = env.maze_map == 0
        self.cells = [(int(i), int(j)) for i, j in np.argwhere(free)]
        self.corners = [cell for cell in self.cells if not _is_hallway(free, cell)]
        walls = torch.from_numpy(~free)
        self.steps = {cell: shortest_path_lengths(walls, cell).numpy() for cell in self.cells}
        """Cells of the shortest way from a cell to each; -1: none."""
        self.centres: dict[tuple[Cell, Cell], np.ndarray] = {}
        self.walk: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda seen, way: way
        if walker:
            from torchrl_hmcts.trainers.experiments.ogbench.ants import AntWalker

            self.walk = AntWalker(walker)

    def episode(self, made: gymnasium.Env) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        env, recipe = self.env, self.recipe
        begin, goal = self._draw(self.cells), self._draw(self.corners)
        if recipe.kind == "stitch":
            goal = self._draw([c for c in self.cells if self.steps[begin][c] == 4] or [begin])
        options = {"task_info": {"init_ij": begin, "goal_ij": goal}}
        observation, _ = made.reset(options=options)
        over, step, way = False, 0, np.zeros(2)
        while not over:
            if recipe.kind != "explore":
                place = env.get_xy()
                way = self.centre(env.xy_to_ij(place), env.xy_to_ij(env.cur_goal_xy)) - place
            elif step % 10 == 0:
                way = self.draws.normal(size=2)
            action = self.walk(observation, way / (np.linalg.norm(way) + 1e-6))
            action = np.clip(action + self.draws.normal(0, recipe.noise, len(action)), -1, 1)
            after, _, terminated, truncated, info = made.step(action)
            yield observation, action
            observation, over, step = after, terminated or truncated, step + 1
            if info["success"] and recipe.kind == "navigate":
                env.set_goal(self._draw(self.corners))

    def _draw(self, cells: list[Cell]) -> Cell:
        return cells[self.draws.integers(len(cells))]

    def centre(self, here: Cell, goal: Cell) -> np.ndarray:
        """The centre of the next cell on the shortest way."""
        if (here, goal) not in self.centres:
            left = self.steps[goal]
            near = [(here[0] + i, here[1] + j) for i, j in _SIDES]
            best = min((here, *(c for c in near if left[c] >= 0)), key=lambda c: left[c])
            self.centres[here, goal] = np.array(self.env.ij_to_xy(best))
        return self.centres[here, goal]


class _Presses:
    """Presses one button after another."""

    def __init__(self, env: Any, recipe: Recipe) -> None:
        from ogbench.manipspace.oracles.plan.button_plan import ButtonPlanOracle

        self.env = env
        self.oracle = ButtonPlanOracle(env=env, noise=recipe.noise, gripper_always_closed=True)

    def episode(self, made: gymnasium.Env) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        observation, info = made.reset()
        self.oracle.reset(observation, info)
        over = False
        while not over:
            action = np.clip(self.oracle.select_action(observation, info), -1, 1)
            after, _, terminated, truncated, info = made.step(action)
            yield observation, action
            observation, over = after, terminated or truncated
            if self.oracle.done:
                self.oracle.reset(*self.env.set_new_target())


def _is_hallway(free: np.ndarray, cell: Cell) -> bool:
    """Whether a cell has nothing but two free sides, opposite ones."""
    up, left, down, right = (bool(free[cell[0] + i, cell[1] + j]) for i, j in _SIDES)
    return (up, left, down, right) in ((True, False, True, False), (False, True, False, True))


def load(path: str | Path) -> TensorDictBase:
    """Read recorded episodes: a folder that :func:`save` wrote, or OGBench's own ``.npz``."""
    path = Path(path)
    if path.suffix != ".npz":
        found = TensorDict.load_memmap(path, allow_pickle=False)
        if not {"observation", "action", "done"} <= set(found.keys()):
            raise ValueError(f"{path} holds no recorded episodes: {sorted(found.keys())}.")
        return found
    with np.load(path, allow_pickle=False) as arrays:
        names = {"observation": "observations", "action": "actions", "done": "terminals"}
        if missing := sorted(set(names.values()) - set(arrays)):
            raise ValueError(f"{path} is no file of OGBench's: it lacks {', '.join(missing)}.")
        parts = {key: torch.from_numpy(np.asarray(arrays[name])) for key, name in names.items()}
    ends = parts.pop("done").bool().reshape(-1, 1)
    floats = {key: part.float() for key, part in parts.items()}
    return TensorDict({**floats, "done": ends}, [len(ends)])


def save(data: TensorDictBase, folder: str | Path) -> None:
    """Write recorded episodes, whole or not at all, as memory-mapped tensors."""
    Path(folder).parent.mkdir(parents=True, exist_ok=True)
    with replacing(folder) as temporary:
        data.memmap(temporary)
