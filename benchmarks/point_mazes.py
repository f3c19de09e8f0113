"""Plans over learned skills in point mazes: PointMaze_Large-v3 and OGBench's three.

    python benchmarks/point_mazes.py --seeds 0 1 2 --out docs/results/settable/point_mazes.json

``HMCTS(id, num_skills=4).learn(STEPS)`` at its defaults, the same in every maze: DIAYN's skills,
without reward; one plan from each start; its options executed in another instance of the env. In
OGBench start number i is of task i modulo 5, with the env's own noise on start and goal.
CPU-seconds of a plan are those of the search, in one process (``time.process_time``).

Beside it, at the option length and novelty radius of the learned agent: eight fixed directions, and
skills after 64 base steps of training. Their searches end at LIMIT base steps.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_hmcts.trainers import HMCTS

ENVS = ["PointMaze_Large-v3", "pointmaze-medium-v0", "pointmaze-large-v0", "pointmaze-giant-v0"]
SKILLS, STEPS, LIMIT = 4, 30_000, 30_000
COMMAND = (
    "python benchmarks/point_mazes.py --seeds 0 1 2 --starts 50 --ablation-starts 0 "
    "--out docs/results/settable/point_mazes.json"
)


def spread(values: np.ndarray) -> dict[str, float]:
    shares = {"median": 0.5, "p95": 0.95, "most": 1.0}
    return {name: round(float(np.quantile(values, q)), 3) for name, q in shares.items()}


def solve(agent: HMCTS, num_starts: int) -> dict[str, Any]:
    """Plan and act from each start."""
    kit, planner = agent.kit, agent.planner
    search, seconds = planner.search, []

    def timed(*args: Any, **keywords: Any) -> Any:
        begin = time.process_time()
        found = search(*args, **keywords)
        seconds.append(time.process_time() - begin)
        return found

    starts = kit.starts("test", num_starts)
    search(starts[:1])  # compiles what is compiled
    planner.search = timed  # type: ignore[method-assign]
    results = kit.act(planner, agent.real_env, starts)
    solved = results.solved
    return {
        "starts": num_starts,
        "solved": int(solved.sum()),
        "unsolved": np.flatnonzero(~solved).tolist(),
        "simulated_steps": spread(results.simulated_steps),
        "cpu_seconds": spread(np.array(seconds)),
        "steps_per_cpu_second": round(float(results.simulated_steps.sum() / sum(seconds))),
        "episode_steps": spread(results.episode_steps[solved]) if solved.any() else None,
    }


def run(
    name: str, seed: int, starts: int, ablation_starts: int, known: dict[str, Any]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Learn and plan in one env, and beside it the ablations; give each as it is done.

    With no starts nothing is learned; the ablations take the settings of the ``known`` row.
    """
    keys = ("option_steps", "skill_steps", "novelty_radius")
    found = {key: known[key] for key in keys if key in known}
    if starts:
        begin = time.process_time()
        agent = HMCTS(name, num_skills=SKILLS, seed=seed).learn(STEPS, progress=False)
        seconds = round(time.process_time() - begin, 1)
        found = {key: getattr(agent.config, key) for key in keys}
        yield "learned", {"training_cpu_seconds": seconds, **found, **solve(agent, starts)}
    if ablation_starts:
        same = {**found, "planner": {"budget": {"base_steps": LIMIT}}}
        fixed = HMCTS(name, seed=seed, **same)
        yield "eight fixed directions", solve(fixed, ablation_starts)
        untrained = HMCTS(name, num_skills=SKILLS, seed=seed, **same).learn(64, progress=False)
        yield "untrained", solve(untrained, ablation_starts)


def add(out: Path, name: str, seed: int, way: str, row: dict[str, Any]) -> None:
    """Add a row to the file, which other processes may have begun."""
    told: dict[str, Any] = {"command": COMMAND, "skills": SKILLS, "training_steps": STEPS}
    if out.is_file():
        told = json.loads(out.read_text())
    runs = told.setdefault("runs", {}).setdefault(name, {})
    runs.setdefault(str(seed), {})[way] = row
    out.write_text(json.dumps(told, indent=1, sort_keys=True) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("envs", nargs="*", default=ENVS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--starts", type=int, default=50, help="0: the ablations only")
    parser.add_argument("--ablation-starts", type=int, default=10, help="of the first seed")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for seed in arguments.seeds:
        for name in arguments.envs:
            others = arguments.ablation_starts if seed == arguments.seeds[0] else 0
            before = json.loads(arguments.out.read_text()) if arguments.out.is_file() else {}
            known = before.get("runs", {}).get(name, {}).get(str(seed), {}).get("learned", {})
            for way, row in run(name, seed, arguments.starts, others, known):
                print(name, seed, way, row, flush=True)
                add(arguments.out, name, seed, way, row)


if __name__ == "__main__":
    main()
