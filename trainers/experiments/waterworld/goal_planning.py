"""The goal-based agent of the mazes: a manager that plans over tiles, and the worker's env.

Letters: m states to plan from, M mazes, H rows, W columns, T = H W tiles, A = 5 options.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from torchrl_hmcts.envs import GridworldMazeEnv, WaterworldMazeEnv
from torchrl_hmcts.planners import (
    GoalPlanner,
    MCTSPlanner,
    RadiusNovelty,
    Search,
    SearchBudget,
    SearchSettings,
)
from torchrl_hmcts.planners.outcomes import Outcomes, RootStates
from torchrl_hmcts.planners.tree import EXPANDED, PRUNED, TERMINAL
from torchrl_hmcts.transforms import PlansGoals, SubgoalTransform

_GAMMA = 0.99  # per tile; any discount below 1 makes the shortest plan the best
_IN_KEYS = ("maze_index", "position", "target")


def make_tile_planner(env: WaterworldMazeEnv, **planner_kwargs: Any) -> GoalPlanner:
    """Make the manager of Waterworld's mazes from the planner and the Gridworld of the same mazes.

    A tile is searched once, and again when a shorter way to it is found (:class:`RadiusNovelty`
    with ``shorter_paths``), until nothing is left to find: the plan is then a shortest path in
    tiles, in any order of the search.

    Args:
        env: Waterworld, or another env with such a state and ``mazes``.
        **planner_kwargs: passed to :class:`MCTSPlanner`, in place of the settings above.

    Returns:
        The manager: goals are the centres of the tiles behind the player's, float32 ``[m, L, 2]``,
        the target's last. On the target's tile the plan is that tile.

    Reference:
        Dissertation, sections 3.1.2 and 3.2.1.

    Example:
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv, maze_from_text
        >>> maze, _, _ = maze_from_text("..#\\n...")
        >>> env = WaterworldMazeEnv(maze[None])
        >>> manager = make_tile_planner(env)
        >>> goals, lengths = manager.plan_goals(env.make_state(0, [[0.4, 0.6]], (2.5, 1.5)))
        >>> lengths.tolist(), goals[0, -1].tolist()
        ([3], [2.5, 1.5])
    """
    macro_env = GridworldMazeEnv(env.mazes, observation=False, seed=0, device=env.device)
    num_tiles = env.height * env.width
    settings = {
        "gamma": _GAMMA,
        "novelty": RadiusNovelty("position", 0.5, shorter_paths=True, max_relaxations=0),
        "budget": SearchBudget(expansions=100 * num_tiles, until_plan=False),
        "leaves_per_wave": min(num_tiles, 255),
        "seed": 0,
        **planner_kwargs,
    }

    def to_macro(td: TensorDictBase) -> TensorDictBase:
        return macro_env.state_from_positions(td["maze_index"], td["position"], td["target"])

    return GoalPlanner(MCTSPlanner(macro_env, **settings), to_macro, in_keys=_IN_KEYS)


class TilePlanner:
    r"""The manager of :func:`make_tile_planner` without tensordicts: a tenth of the time per plan.

    The same tree search, tree policy and novelty test (:class:`~torchrl_hmcts.planners.Search`) on
    a table of the Gridworld's moves. A search ends as soon as no open node can hold a shorter plan
    than the best one: with :math:`k` the tiles from the root and :math:`h` the tiles to the target
    if there were no walls,

    .. math:: \min_{s \text{ open}} k(s) + h(s) \ge k(\text{best plan}).

    Args:
        env: Waterworld, or another env with such a state and ``mazes``.

    Reference:
        Dissertation, sections 3.1.2 and 3.2.1. The bound is that of A* (Hart, Nilsson and Raphael,
        1968).

    Example:
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv, maze_from_text
        >>> maze, _, _ = maze_from_text("..#\n...")
        >>> env = WaterworldMazeEnv(maze[None])
        >>> goals, lengths = TilePlanner(env).plan_goals(
        ...     env.make_state(0, [[0.4, 0.6]], (2.5, 1.5)))
        >>> goals[0].tolist()
        [[0.5, 1.5], [1.5, 1.5], [2.5, 1.5]]
    """

    in_keys = list(_IN_KEYS)

    def __init__(self, env: WaterworldMazeEnv) -> None:
        self.width = env.width
        self.moves = tile_moves(env.mazes.cpu())  # [M, T, A]
        tiles = np.arange(env.height * env.width)
        columns_rows = np.stack((tiles % env.width, tiles // env.width), -1)
        self._centers = (columns_rows + 0.5).astype(np.float32)  # [T, 2]
        self._apart = np.abs(columns_rows[:, None] - columns_rows).sum(-1)  # [T, T] without walls
        self.last_search: Search | None = None

    def plan_goals(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Plan from states.

        Args:
            tensordict (TensorDictBase): states, batch ``[m]``: ``"maze_index"`` (int64),
                ``"position"`` and ``"target"`` (float32 ``[m, 2]``, inside the maze).

        Returns:
            the goals, float32 ``[m, L, 2]``, the last one repeated, and the lengths, int64 ``[m]``.
        """
        maze = tensordict.get("maze_index").numpy(force=True)
        start, target = (self._tile(tensordict.get(key)) for key in ("position", "target"))
        search, tiles = self._search(maze, start, target)
        self.last_search = search
        paths = [
            tiles[b, search.tree.path(b, int(node))[1:]] for b, node in enumerate(search.best_node)
        ]
        lengths = np.array([len(path) for path in paths])
        width = int(lengths.max(initial=0))
        padded = np.stack([np.pad(path, (0, width - len(path)), "edge") for path in paths])
        return torch.from_numpy(self._centers[padded]), torch.from_numpy(lengths)

    def _tile(self, position: Tensor) -> np.ndarray:
        column_row = position.numpy(force=True).astype(np.int64)
        tile: np.ndarray = column_row[:, 1] * self.width + column_row[:, 0]
        return tile

    def _search(
        self, maze: np.ndarray, start: np.ndarray, target: np.ndarray
    ) -> tuple[Search, np.ndarray]:
        """Search, and return with the trees the tile of every node, int64 ``[m, N]``."""
        m, num_options = len(maze), self.moves.shape[-1]
        search = Search(
            m,
            num_options,
            SearchSettings(
                novelty=RadiusNovelty("tile", 0.5, shorter_paths=True, max_relaxations=0),
                leaves_per_wave=16,  # about all that are open at a time
            ),
            capacity=512,
        )
        priors = np.zeros((0, num_options), np.float32)
        masks = np.zeros((0, num_options), np.bool_)
        tiles = np.zeros((m, search.tree.capacity), np.int64)
        tiles[:, 0] = start
        search.plant(
            RootStates(
                values=np.zeros(m, np.float32),
                done=np.zeros(m, np.bool_),
                priors=priors,
                masks=masks,
                features=start[:, None].astype(np.float32),
            )
        )
        active = np.arange(m)
        while len(active):
            wave = search.select(active)
            after = self.moves[maze[wave.roots], tiles[wave.roots, wave.nodes], wave.options]
            arrived = after == target[wave.roots]
            nodes = search.insert(
                wave,
                Outcomes(
                    rewards=arrived.astype(np.float32),
                    discounts=np.where(arrived, 0.0, _GAMMA).astype(np.float32),
                    durations=np.ones(len(wave), np.int64),
                    done=arrived,
                    values=np.zeros(len(wave), np.float32),
                    priors=priors,
                    masks=masks,
                    features=after[:, None].astype(np.float32),
                ),
            )
            if search.tree.capacity > tiles.shape[1]:
                tiles = np.pad(tiles, ((0, 0), (0, search.tree.capacity - tiles.shape[1])))
            tiles[wave.roots, nodes] = after
            active = active[~search.exhausted(active)]
            found = search.best_node[active] >= 0
            if found.any():
                shortest = np.zeros(len(active), np.bool_)
                shortest[found] = self._is_shortest(search, tiles, target, active[found])
                active = active[~shortest]
        return search, tiles

    def _is_shortest(
        self, search: Search, tiles: np.ndarray, target: np.ndarray, roots: np.ndarray
    ) -> np.ndarray:
        """Whether no open node of the roots can hold a shorter plan than the best, bool."""
        used = int(search.tree.num_nodes[roots].max())
        nodes = search.tree.nodes[roots, :used]
        is_open = (nodes["flags"] & (EXPANDED | PRUNED | TERMINAL)) == 0
        is_open &= np.arange(used) < search.tree.num_nodes[roots, None]
        bound = nodes["base_steps"] + self._apart[tiles[roots, :used], target[roots, None]]
        best = nodes["base_steps"][np.arange(len(roots)), search.best_node[roots]]
        shortest: np.ndarray = np.where(is_open, bound, np.iinfo(np.int64).max).min(-1) >= best
        return shortest


def tile_moves(mazes: Tensor) -> np.ndarray:
    """Read off the Gridworld of ``[M, H, W]`` where actions lead, int16 ``[M, T, A]``."""
    env = GridworldMazeEnv(mazes, observation=False, seed=0)
    num_tiles, num_actions = env.height * env.width, int(env.action_spec.space.n)
    state = env.reset().expand(env.num_mazes, num_tiles, num_actions).clone()
    state["maze_index"][:] = torch.arange(env.num_mazes)[:, None, None]
    state["player_tile"][:] = torch.arange(num_tiles)[:, None]
    state["action"] = torch.arange(num_actions).expand(state.shape).contiguous()
    return env.step(state)["next", "player_tile"].to(torch.int16).numpy()


def make_goal_env(
    mazes: Tensor | None = None,
    *,
    planner: PlansGoals | None = None,
    max_steps: int = 1000,
    observation: bool = True,
    batch_size: Sequence[int] = (),
    seed: int | None = None,
    **subgoal_kwargs: Any,
) -> TransformedEnv:
    """Make the worker's env: Waterworld with the manager's goals and the worker's reward.

    Args:
        mazes: bool ``[M, H, W]``. Default: the training split.
        planner: the manager. Default: a :class:`TilePlanner`.
        max_steps, observation, batch_size, seed: as in :class:`WaterworldMazeEnv`.
        **subgoal_kwargs: passed to :class:`SubgoalTransform`.

    Returns:
        The env. Its ``max_goals`` are the free tiles of a maze, so that no plan is cut.

    Example:
        >>> env = make_goal_env(batch_size=[4], seed=0)
        >>> td = env.rollout(5)
        >>> td["goals"].shape, td["next", "reward"].shape
        (torch.Size([4, 5, 6]), torch.Size([4, 5, 1]))
    """
    own: dict[str, Any] = {"max_steps": max_steps, "observation": observation}
    env = WaterworldMazeEnv(mazes, batch_size=batch_size, seed=seed, **own)
    settings = {"max_goals": env.height * env.width - env.num_walls, **subgoal_kwargs}
    manager = TilePlanner(env) if planner is None else planner
    return TransformedEnv(env, SubgoalTransform(manager, **settings))
