"""Gymnasium envs that are set to a state: to the bit, and how long reading and restoring take.

    python benchmarks/settable_envs.py --out docs/results/settable/envs.json
    python benchmarks/settable_envs.py CartPole-v1 Ant-v5

Each env: 50 states, 200 steps from each, in the same instance, a second one and a second process.
Times are CPU microseconds of one core, the mean of 300 calls, the lowest of five such. Needs the
extras ``gym`` and ``atari``; what is missing is left out and named.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
import timeit
import warnings
from pathlib import Path
from typing import Any

import torch

from torchrl_hmcts.envs import AttributeSnapshot, SettableGymEnv
from torchrl_hmcts.testing import check_settable

ATARI = {"repeat_action_probability": 0.0, "obs_type": "ram"}
IDS: dict[str, tuple[str, ...]] = {
    "classic control": (
        "CartPole-v1",
        "MountainCar-v0",
        "MountainCarContinuous-v0",
        "Acrobot-v1",
        "Pendulum-v1",
    ),
    "toy text": ("FrozenLake-v1", "FrozenLake8x8-v1", "Taxi-v4", "CliffWalking-v1", "Blackjack-v1"),
    "Box2D": ("LunarLander-v3", "BipedalWalker-v3"),
    "MuJoCo": (
        "HalfCheetah-v5",
        "Hopper-v5",
        "Walker2d-v5",
        "Ant-v5",
        "Humanoid-v5",
        "Swimmer-v5",
        "Reacher-v5",
        "InvertedPendulum-v5",
    ),
    "gymnasium-robotics": ("PointMaze_UMaze-v3", "PointMaze_Large-v3", "AntMaze_Large-v5"),
    "MiniGrid": (
        "MiniGrid-FourRooms-v0",
        "MiniGrid-DoorKey-16x16-v0",
        "MiniGrid-KeyCorridorS3R3-v0",
        "MiniGrid-ObstructedMaze-1Dlhb-v0",
        "MiniGrid-Dynamic-Obstacles-8x8-v0",
        "BabyAI-GoToLocal-v0",
    ),
    "OGBench": (
        "pointmaze-giant-v0",
        "pointmaze-teleport-v0",
        "antmaze-giant-v0",
        "humanoidmaze-medium-v0",
        "cube-single-v0",
        "puzzle-3x3-v0",
    ),
    "Atari": ("ALE/Breakout-v5", "ALE/Pong-v5", "ALE/Seaquest-v5"),
}


def measure(name: str, check: bool) -> dict[str, Any]:
    """Checks one env, if asked; returns what was found and its times after a step."""
    keywords = ATARI if name.startswith("ALE/") else {}
    make = functools.partial(SettableGymEnv, name, **keywords)
    env = make(seed=0)
    snapshot = env.snapshot
    row: dict[str, Any] = {"id": name, "snapshot": type(snapshot).__name__, "bytes": snapshot.width}
    begin = time.process_time()
    try:
        if check:
            check_settable(make)
            row["differing"] = 0
    except Exception as error:
        row["differing"] = str(error)[:200]
    row["check_seconds"] = round(time.process_time() - begin, 1)
    rows = [step["snapshot"].numpy() for step in env.rollout(30)]
    counter = iter(range(10**9))

    attributes = isinstance(snapshot, AttributeSnapshot)

    def read() -> None:
        if attributes:  # else reading twice, or what was read last, costs nothing
            snapshot.note_step(None)
        snapshot.read()

    def restore() -> None:
        if attributes:
            snapshot.note_step(None)
        snapshot.restore(rows[7 * next(counter) % len(rows)])

    def micro(call: Any) -> float:
        times = timeit.repeat(call, number=300, repeat=5, timer=time.process_time)
        return round(min(times) / 300 * 1e6, 1)

    row["read_us"], row["restore_us"] = micro(read), micro(restore)
    if hasattr(snapshot, "_mj"):
        state = snapshot._state
        mujoco, model, data = snapshot._mj, snapshot.model, snapshot.data
        mujoco.mj_getState(model, data, state, snapshot._spec)
        row["mj_setState_us"] = micro(
            lambda: mujoco.mj_setState(model, data, state, snapshot._spec)
        )
        if snapshot.forward:
            row["mj_forward_us"] = micro(lambda: mujoco.mj_forward(model, data))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="*", help="envs; default: all")
    parser.add_argument("--times", action="store_true", help="measure times only")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    rows, missing = [], []
    for family, ids in IDS.items():
        for name in ids:
            if args.ids and name not in args.ids:
                continue
            try:
                rows.append({"family": family, **measure(name, not args.times)})
                print(rows[-1], flush=True)
            except ImportError as error:
                missing.append(f"{name}: {error}")
                print("left out:", missing[-1], flush=True)
    if args.out:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        content = {
            "command": "python benchmarks/settable_envs.py --out docs/results/settable/envs.json",
            "states": 50,
            "steps": 200,
            "envs": rows,
            "left_out": missing,
        }
        args.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
