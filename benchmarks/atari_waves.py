"""Scores of the Atari agent by how many leaves are simulated before any outcome is known.

Run: ``python benchmarks/atari_waves.py --out docs/results/atari/waves.json``. Leaves that are
chosen together keep more processes busy and know less of each other. Plays the same number of real
base steps with each setting, one process, and reports what was simulated for a real step too.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

import torch

from torchrl_hmcts.envs import RepeatActions
from torchrl_hmcts.trainers import AtariAgent, AtariKit, AtariSearch

SETTINGS = ((1, 1), (4, 1), (4, 2), (8, 2))  # leaves per wave, waves in flight


def play(game: str, leaves: int, waves: int, seed: int, args: argparse.Namespace) -> dict[str, Any]:
    kit = AtariKit(game, num_processes=0, seed=seed)
    pool = kit.make_pool(RepeatActions(len(kit.action_names)), args.steps)
    search = AtariSearch(ratio=args.ratio, leaves_per_wave=leaves, waves_in_flight=waves)
    agent = AtariAgent(pool, search, seed=seed)
    agent.begin()
    before = pool.num_frames
    agent.play(max_steps=args.real_steps)
    return {
        "game": game,
        "leaves_per_wave": leaves,
        "waves_in_flight": waves,
        "seed": seed,
        "score": agent.score,
        "real_steps": agent.real_steps,
        "simulated_per_real_step": (pool.num_frames - before) / 4 / agent.real_steps - 1,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--games", nargs="+", default=["Breakout", "SpaceInvaders", "Seaquest"])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=10, help="steps of an option")
    parser.add_argument("--ratio", type=float, default=50.0)
    parser.add_argument("--real-steps", type=int, default=600)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    runs = []
    print("| game | leaves | waves | scores | simulated per real step |\n|---|---|---|---|---|")
    for game in args.games:
        for leaves, waves in SETTINGS:
            group = [play(game, leaves, waves, seed, args) for seed in range(args.seeds)]
            scores = ", ".join(f"{run['score']:g}" for run in group)
            simulated = statistics.fmean(run["simulated_per_real_step"] for run in group)
            print(f"| {game} | {leaves} | {waves} | {scores} | {simulated:.0f} |", flush=True)
            runs += group
    if args.out is not None:
        result = {
            "command": "python benchmarks/atari_waves.py",
            "arguments": {k: v for k, v in vars(args).items() if k != "out"},
            "runs": runs,
        }
        args.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
