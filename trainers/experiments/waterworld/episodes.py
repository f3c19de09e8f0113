"""Episodes in Waterworld from given starts: what they cost, and what they looked like.

Letters: S starts, an episode each, L base steps of one, G goals of a plan.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import index

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type


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
        """Return the goals of the plan that was followed at a base step, ``[G, 2]``."""
        return self.plans[max(made for made in self.plans if made <= step)]


@dataclass
class MazeTest:
    """Results of an agent in test mazes, one episode each."""

    solved: Tensor  # bool [S], reached the target in time
    base_steps: Tensor  # int64 [S], length of the episode
    last: TensorDictBase  # [S] last state of each episode, with the counters that it has
    tracks: list[GoalTrack]  # what was recorded to draw, if anything

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
    record: bool = False,
    seed: int = 0,
) -> MazeTest:
    """Play one episode from each start, all side by side, until it ends by itself or is cut off.

    Args:
        policy: reads a root and writes ``"action"``.
        env: stateless, of no batch size; may be transformed. It is set to the starts.
        starts: states ``[S]``, as ``make_starts`` gives them.
        deterministic: take the most probable actions. Default: sample.
        record: keep what pictures need, in an env of :func:`make_goal_env`.
        seed: of the sampling.

    Returns:
        Which episodes were ``solved``, their ``base_steps``, their ``last`` states ``[S]`` with the
        counters of goals, their ``tracks`` if recorded, and a ``summary()``.

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
    recorder = _Recorder(count) if record else None
    with torch.random.fork_rng(devices=[]), set_exploration_type(mode):
        torch.manual_seed(index(seed))
        while len(state):
            transition = env.step(policy(state))
            start = transition["start"]
            state = transition["next"].set("start", start)
            if recorder is not None:
                rows = start.numpy(force=True)
                if not steps.any():
                    recorder.add(rows, transition)
                recorder.add(rows, state)
            steps[start] += 1
            done = state["done"].squeeze(-1)
            solved[start] = state["terminated"].squeeze(-1)
            if done.any():
                last.append(state[done])
                state = state[~done]
    ended: TensorDictBase = torch.cat(last)  # type: ignore[arg-type, assignment]
    tracks = [] if recorder is None else recorder.tracks(solved)
    return MazeTest(solved, steps, ended[ended["start"].argsort()], tracks)


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

    def tracks(self, solved: Tensor) -> list[GoalTrack]:
        columns = zip(self.positions, self.plans, self.index, solved.tolist(), strict=True)
        return [GoalTrack(np.stack(p), plans, np.array(i), ok) for p, plans, i, ok in columns]
