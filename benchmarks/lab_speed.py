"""Frames per second of LabMazeEnv: batched, and one env through ``rollout``.

Run: ``python benchmarks/lab_speed.py``. Compiling is not counted. Wall time is what a user
waits; on a machine that is busy otherwise, the frames per CPU second say more.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_hmcts.envs import LabMazeEnv

READ_OUTS: dict[str, tuple[str, ...]] = {
    "state and four read-outs": ("tile_position", "heading", "body_velocity", "goal"),
    "state only": (),
}


def measured(run: Callable[[], int], repeats: int) -> dict[str, int]:
    """The best of some runs, in frames per second of wall and of CPU time."""
    run()
    wall, cpu = [], []
    for _ in range(repeats):
        began, worked = time.perf_counter(), time.process_time()
        frames = run()
        wall.append(frames / (time.perf_counter() - began))
        cpu.append(frames / (time.process_time() - worked))
    return {"frames_per_second": round(max(wall)), "frames_per_cpu_second": round(max(cpu))}


def batched(copies: int, num_steps: int, read_outs: tuple[str, ...], steps: int) -> Any:
    env = LabMazeEnv(num_steps=num_steps, terminate_on_goal=False, read_outs=read_outs, seed=0)
    start = env.reset(TensorDict(batch_size=[copies]))
    actions = torch.randint(9, (steps, copies), generator=torch.Generator().manual_seed(0))

    def run() -> int:
        td: TensorDictBase = start
        for action in actions:
            td = env._step(td.set("action", action))
        return steps * copies * num_steps

    return run


def single(num_steps: int, read_outs: tuple[str, ...], steps: int) -> Any:
    env = LabMazeEnv(num_steps=num_steps, terminate_on_goal=False, read_outs=read_outs, seed=0)
    forward = torch.tensor(0)

    def run() -> int:
        env.rollout(steps, policy=lambda td: td.set("action", forward))
        return steps * num_steps

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the steps")
    parser.add_argument("--threads", type=int, default=1, help="of torch; default 1")
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    share = 10 if arguments.quick else 1
    rows = []
    for writes, read_outs in READ_OUTS.items():
        for copies in (64, 1024, 8192):
            for num_steps in (1, 4, 10):
                steps = max(2, 400_000 // (copies * num_steps * share))
                run = batched(copies, num_steps, read_outs, steps)
                rows.append(
                    {
                        "how": f"batch of {copies}",
                        "writes": writes,
                        "num_steps": num_steps,
                        **measured(run, 5),
                    }
                )
        for num_steps in (1, 4, 10, 20):
            run = single(num_steps, read_outs, 1000 // share)
            row = {"how": "one env, rollout", "writes": writes, "num_steps": num_steps}
            rows.append({**row, **measured(run, 5)})
    print("| env | writes | num_steps | frames/s | frames/CPU-s |\n|---|---|---|---|---|")
    for row in rows:
        print("| " + " | ".join(f"{x:,}" if isinstance(x, int) else x for x in row.values()) + " |")
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
