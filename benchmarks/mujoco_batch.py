"""Env steps per CPU-second: MujocoBatch, mujoco.rollout and the Gymnasium env, in turns.

    python benchmarks/mujoco_batch.py --out docs/results/settable/mujoco_batch.json

Random actions from the same states. ``rollout`` is MuJoCo's own batch in C with the same number of
physics steps, without observation, reward and end; it does not hand out the solver's warm start, so
that its steps are not those of the env: ``differs`` is by how much the position is another after
100 steps with the same actions, in metres (MujocoBatch: 0). Figures are medians of the rounds, the
ratios those within a round.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout
from table import read_arguments, write

from torchrl_hmcts.envs import MujocoBatch
from torchrl_hmcts.envs.gym.mujoco import find_physics
from torchrl_hmcts.envs.gym.settable import make_gym

ENVS = ["PointMaze_Large-v3", "AntMaze_Large-v5", "pointmaze-giant-v0", "antmaze-giant-v0"]
BATCH = 64


def speed(step: Callable[[], int], seconds: float) -> float:
    """Env steps per CPU-second of calls that return how many they took."""
    steps, begin = 0, time.process_time()
    while time.process_time() - begin < seconds:
        steps += step()
    return steps / (time.process_time() - begin)


class Contest:
    """One env, stepped in three ways."""

    def __init__(self, name: str) -> None:
        self.env = make_gym(name)
        self.env.reset(seed=0)
        self.env.action_space.seed(0)
        self.batch = MujocoBatch(name, batch_size=[BATCH], seed=0)
        self.state = self.batch.reset()
        self.model, _ = find_physics(self.env)
        self.data, self.pool = mujoco.MjData(self.model), rollout.Rollout(nthread=0)
        kind = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.numbers = mujoco.mj_stateSize(self.model, kind)
        self.rows = self.state["physics"][:, : self.numbers].numpy().copy()
        self.draws = np.random.default_rng(0)

    def gymnasium(self) -> int:
        _, _, terminated, truncated, _ = self.env.step(self.env.action_space.sample())
        if terminated or truncated:
            self.env.reset()
        return 1

    def batched(self) -> int:
        td = self.state.set("action", self.batch.action_spec.rand())
        self.state = self.batch.step(td)["next"]
        return BATCH

    def rolled(self) -> int:
        action = self.draws.uniform(-1, 1, (BATCH, 1, self.model.nu))
        action = np.ascontiguousarray(action.repeat(self.batch.task.frame_skip, 1))
        states, _ = self.pool.rollout(self.model, self.data, self.rows, action)
        self.rows = states[:, -1].copy()
        return BATCH

    def difference(self) -> float:
        """Distance between where ``rollout`` and MujocoBatch are after 100 steps, the mean."""
        td, rows = self.batch.reset(), None
        for _ in range(100):
            rows = td["physics"][:, : self.numbers].numpy().copy() if rows is None else rows
            action = self.batch.action_spec.rand()
            td = self.batch.step(td.set("action", action))["next"]
            repeated = action.double().numpy()[:, None].repeat(self.batch.task.frame_skip, 1)
            rows = self.pool.rollout(self.model, self.data, rows, repeated)[0][:, -1].copy()
        return float(np.linalg.norm(rows[:, 1:3] - td["physics"][:, 1:3].numpy(), axis=-1).mean())


def main() -> None:
    quick: dict[str, Any] = {"rounds": 1, "seconds": 0.2}
    arguments = read_arguments(__doc__ or "", quick, seeds=[0], envs=ENVS, rounds=5, seconds=1.5)
    rows = []
    for name in arguments.envs:
        contest = Contest(name)
        ways = (contest.gymnasium, contest.batched, contest.rolled)
        rounds = [[speed(way, arguments.seconds) for way in ways] for _ in range(arguments.rounds)]
        theirs, ours, rolled = (
            round(statistics.median(column)) for column in zip(*rounds, strict=True)
        )
        row = {"id": name, "gymnasium": theirs, "mujoco_batch": ours, "rollout": rolled}
        row["ratio"] = round(statistics.median(r[1] / r[0] for r in rounds), 2)
        row["rollout_ratio"] = round(statistics.median(r[2] / r[0] for r in rounds), 2)
        if name.lower().startswith("ant"):  # points have a law of motion of their own
            row["rollout_differs"] = contest.difference()
        rows.append(row)
        print(row, flush=True)
    command = "python benchmarks/mujoco_batch.py --out docs/results/settable/mujoco_batch.json"
    write(arguments, {"command": command, "batch": BATCH, "rows": rows})


if __name__ == "__main__":
    main()
