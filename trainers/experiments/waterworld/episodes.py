"""Episodes in Waterworld from given starts: what they cost, and what they looked like.

Letters: S and M starts, an episode each, L base steps of one, G goals of a plan.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from operator import index
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_hmcts.trainers.evaluation import spread


@dataclass
class MazeTest:
    """Results of an agent in test mazes, one episode each."""

    solved: Tensor  # bool [S], reached the target in time
    base_steps: Tensor  # int64 [S], length of the episode
    last: TensorDictBase  # [S] last state of each episode, with the counters that it has

    def summary(self) -> dict[str, float | None]:
        """Return how many were solved, and the base steps of these episodes and of all."""
        steps = self.base_steps[self.solved].double()
        some = len(steps) > 0
        return {
            "mazes": len(self.solved),
            "solved": len(steps),
            "solved_share": round(len(steps) / len(self.solved), 4),
            "base_steps_mean": round(float(steps.mean()), 1) if some else None,
            "base_steps_median": float(steps.median()) if some else None,
            "base_steps_max": int(steps.max()) if some else None,
            "base_steps_mean_all": round(float(self.base_steps.double().mean()), 1),
        }


@torch.no_grad()
def play_mazes(
    policy: Callable[[TensorDictBase], TensorDictBase],
    env: EnvBase,
    starts: TensorDictBase,
    *,
    deterministic: bool = False,
    seed: int = 0,
    watch: Callable[[TensorDictBase], Any] | None = None,
) -> MazeTest:
    """Play one episode from each start ``[S]``, side by side, until it ends or is cut off.

    ``watch`` is called after every step with the transitions of the running episodes, which have
    the entry ``"start"`` (int64, from which of the starts).

    Example:
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> env = WaterworldMazeEnv(torch.zeros(1, 1, 3, dtype=torch.bool))
        >>> def to_the_right(td):
        ...     return td.set("action", torch.full(td.batch_size, 3))
        >>> play_mazes(to_the_right, env, env.make_state(0, [[0.5, 0.5]], (2.5, 0.5))).base_steps
        tensor([24])
    """
    mode = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    state = env.reset(starts.clone(), set_state=True)
    count = len(starts)
    state.set("start", torch.arange(count))
    solved = torch.zeros(count, dtype=torch.bool)
    steps = torch.zeros(count, dtype=torch.int64)
    last: list[TensorDictBase] = []
    with torch.random.fork_rng(devices=[]), set_exploration_type(mode):
        torch.manual_seed(index(seed))
        while len(state):
            transition = env.step(policy(state))
            if watch is not None:
                watch(transition)
            start = transition["start"]
            state = transition["next"].set("start", start)
            steps[start] += 1
            done = state["done"].squeeze(-1)
            solved[start] = state["terminated"].squeeze(-1)
            if done.any():
                last.append(state[done])
                state = state[~done]
    ended: TensorDictBase = torch.cat(last)  # type: ignore[arg-type, assignment]
    return MazeTest(solved, steps, ended[ended["start"].argsort()])


@dataclass
class GoalTrack:
    """One episode to draw: the player's positions and plans.

    Attributes:
        positions (array): float ``[L + 1, 2]``, before and after each base step, in tiles.
        plans (dict): goals of each plan, float ``[G, 2]``, by the base step at which it was made.
        goal_index (array): int ``[L + 1]``, which goal of its plan was current.
        solved (bool): whether the target was reached.

    Example:
        >>> import numpy as np
        >>> plans = {0: np.array([[1.5, 0.5], [2.5, 0.5]])}
        >>> track = GoalTrack(np.zeros((9, 2)), plans, np.zeros(9, int), solved=False)
        >>> track.plan_at(8)[0].tolist()
        [1.5, 0.5]
    """

    positions: np.ndarray
    plans: dict[int, np.ndarray]
    goal_index: np.ndarray
    solved: bool

    def plan_at(self, step: int) -> np.ndarray:
        """Return the goals of the plan that was followed at a base step, ``[G, 2]``.

        Example:
            >>> import numpy as np
            >>> plans = {0: np.zeros((2, 2)), 7: np.ones((1, 2))}
            >>> track = GoalTrack(np.zeros((9, 2)), plans, np.zeros(9, int), solved=False)
            >>> len(track.plan_at(6)), len(track.plan_at(7))
            (2, 1)
        """
        return self.plans[max(made for made in self.plans if made <= step)]


@dataclass
class GoalEpisodes:
    """Episodes of an agent that follows goals, one entry per start, ``[M]``.

    Attributes:
        solved (array): bool, whether the target was reached.
        base_steps (array): int64, how long the episode was.
        num_plans, num_goals_met, num_divergences (array): int64, counts of the episode.
        shortest (array): int64, goals of the first plan: tiles to the target.
        returns (array): float, sum of the worker's rewards.
        tracks (list): what was recorded to draw, if anything.

    Example:
        >>> import numpy as np
        >>> ones = np.ones(3, dtype=np.int64)
        >>> episodes = GoalEpisodes(ones > 0, 50 * ones, *[ones] * 3, 5 * ones, ones)
        >>> episodes.summary()["episodes"]
        3
    """

    solved: np.ndarray
    base_steps: np.ndarray
    num_plans: np.ndarray
    num_goals_met: np.ndarray
    num_divergences: np.ndarray
    shortest: np.ndarray
    returns: np.ndarray
    tracks: list[GoalTrack] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """Return the solved share and the spread of the other columns.

        ``base_steps`` counts unsolved episodes with the steps they took; ``base_steps_per_tile``
        is of the solved ones, per tile of the shortest path.

        Example:
            >>> import numpy as np
            >>> ones = np.ones(2, dtype=np.int64)
            >>> GoalEpisodes(ones > 0, 50 * ones, *[ones] * 3, 5 * ones, ones).summary()["solved"]
            1.0
        """
        per_tile = self.base_steps[self.solved] / self.shortest[self.solved]
        return {
            "episodes": len(self.solved),
            "solved": round(float(self.solved.mean()), 4),
            "base_steps": spread(self.base_steps),
            "base_steps_per_tile": spread(per_tile),
            "goals_met": round(float(self.num_goals_met.mean()), 3),
            "divergences": round(float(self.num_divergences.mean()), 3),
            "plans": round(float(self.num_plans.mean()), 3),
            "worker_return": round(float(self.returns.mean()), 3),
        }


def run_goal_episodes(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    starts: TensorDictBase,
    *,
    record: bool = False,
    deterministic: bool = True,
    seed: int = 0,
) -> GoalEpisodes:
    """Execute a worker's policy from every start to the end of its episode, all side by side.

    Args:
        env: a worker's env, as :func:`~torchrl_hmcts.trainers.make_goal_env` makes it, of no batch
            size.
        policy: reads a root and writes the action.
        starts: states ``[M]``, e.g. ``make_starts``; they are
            given fresh plans.
        record: keep what pictures need.
        deterministic: take the most probable actions. Default: true.
        seed: of the actions, if they are sampled.

    Returns:
        The episodes, in the order of the starts.

    Example:
        >>> from torchrl_hmcts.trainers.experiments.kits.waterworld import make_starts
        >>> from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import make_goal_env
        >>> from torchrl_hmcts.trainers.experiments.waterworld.scripted_expert import ScriptedExpert
        >>> env = make_goal_env(seed=0)
        >>> starts = make_starts(env.base_env, 4, seed=0)
        >>> run_goal_episodes(env, ScriptedExpert(), starts).solved.tolist()
        [True, True, True, True]
    """
    m = len(starts)
    returns, shortest = np.zeros(m), np.zeros(m, np.int64)
    recorder = _Recorder(m) if record else None
    begun = False

    def watch(transition: TensorDictBase) -> None:
        nonlocal begun
        rows, after = transition["start"].numpy(force=True), transition["next"]
        if not begun:
            begun = True
            shortest[rows] = transition["plan_length"].reshape(-1).numpy(force=True)
            if recorder is not None:
                recorder.add(rows, transition)
        returns[rows] += after["reward"].reshape(-1).numpy(force=True)
        if recorder is not None:
            recorder.add(rows, after)

    test = play_mazes(policy, env, starts, deterministic=deterministic, seed=seed, watch=watch)
    solved = test.solved.numpy(force=True)
    num_plans, num_goals_met, num_divergences = (
        test.last[key].reshape(m).numpy(force=True)
        for key in ("num_plans", "num_goals_met", "num_divergences")
    )
    return GoalEpisodes(
        solved=solved,
        base_steps=test.base_steps.numpy(force=True),
        num_plans=num_plans,
        num_goals_met=num_goals_met,
        num_divergences=num_divergences,
        shortest=shortest,
        returns=returns,
        tracks=[] if recorder is None else recorder.tracks(solved),
    )


class _Recorder:
    """Collects positions, goals and plans while episodes run."""

    def __init__(self, m: int) -> None:
        self.positions: list[list[np.ndarray]] = [[] for _ in range(m)]
        self.index: list[list[int]] = [[] for _ in range(m)]
        self.plans: list[dict[int, np.ndarray]] = [{} for _ in range(m)]
        self.num_plans = np.zeros(m, np.int64)

    def add(self, rows: np.ndarray, td: TensorDictBase) -> None:
        position, plan, length, index, count = (
            td[key].numpy(force=True)
            for key in ("position", "plan", "plan_length", "goal_index", "num_plans")
        )
        for i, row in enumerate(rows.tolist()):
            if count[i, 0] > self.num_plans[row]:
                self.num_plans[row] = count[i, 0]
                self.plans[row][len(self.positions[row])] = plan[i, : length[i, 0]].copy()
            self.positions[row].append(position[i].copy())
            self.index[row].append(int(index[i, 0]))

    def tracks(self, solved: np.ndarray) -> list[GoalTrack]:
        return [
            GoalTrack(np.stack(points), plans, np.array(index), bool(ok))
            for points, plans, index, ok in zip(
                self.positions, self.plans, self.index, solved, strict=True
            )
        ]
