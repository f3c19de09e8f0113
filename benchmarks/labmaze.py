"""DeepMind Lab's random maze: what the experiment of chapter 4 gives, over several seeds.

    python benchmarks/labmaze.py --seeds 0 1 2 --out docs/results/lab/labmaze.json
    python benchmarks/labmaze.py --quick

For each seed, a worker is trained by DIAYN in 40,000 frames (10,000 base steps) of 9 x 9 mazes, and
then mazes of all sizes are solved with it, each at the first trial: a plan in the model, carried
out in another instance of the env. Further, in the 9 x 9 mazes: options of fixed length; envs whose
clock and friction differ by 5 % from the model's, with a new plan after every option; workers of
Algorithm 3 from scratch, and of DIAYN with 40,000 base steps (160,000 frames).

Every part is written to ``--out`` as soon as it is known, and the workers to ``--work``; started
again with the same arguments, the script goes on with what is missing.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.trainers.experiments.lab.config import LabMazeConfig
from torchrl_hmcts.trainers.experiments.lab.evaluation import (
    frames_curve,
    solve_mazes,
    solve_with_wrong_model,
    wrong_models,
)
from torchrl_hmcts.trainers.experiments.lab.training import curve_script_frames, train_worker
from torchrl_hmcts.trainers.experiments.lab.worker import make_worker_loss
from torchrl_hmcts.trainers.figures.curves import plot_training, solving_panels

ERROR = 0.05


class Parts:
    """Results by name, kept in a JSON file; what is there already is not computed again."""

    def __init__(self, path: Path, arguments: dict[str, Any]) -> None:
        self.path, self.arguments = path, arguments
        self.results: dict[str, Any] = {}
        if path.exists():
            before = json.loads(path.read_text())
            if before["arguments"] != arguments:
                raise SystemExit(
                    f"{path} was made with {before['arguments']}; choose another --out."
                )
            self.results = before["results"]

    def __call__(self, name: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        if name not in self.results:
            self.results[name] = compute()
            self.path.parent.mkdir(parents=True, exist_ok=True)
            content = {
                "command": "python benchmarks/labmaze.py",
                "arguments": self.arguments,
                "results": self.results,
            }
            self.path.write_text(json.dumps(content, indent=1) + "\n")
            print(f"{name}: {_short(self.results[name])}", flush=True)
        result: dict[str, Any] = self.results[name]
        return result


def trained(
    config: LabMazeConfig, parts: Parts, work: Path, name: str | None = None
) -> SkillPolicy:
    """Train the worker of a seed, or load it."""
    name = f"{config.algorithm} {config.seed}" if name is None else name
    path = work / f"{name.replace(' ', '_')}.pt"
    if not path.exists():
        parts.results.pop(f"{name} training", None)

    def train() -> dict[str, Any]:
        worker = train_worker(config)
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(worker.loss.state_dict(), path)
        return {
            "frames": worker.steps * config.frames_per_step,
            "base_steps": worker.steps,
            "rounds": worker.rounds,
            "cpu_seconds": worker.seconds,
            "curve": frames_curve(worker.tests, config.frames_per_step, config.max_frames),
        }

    parts(f"{name} training", train)
    loss = make_worker_loss(config.num_skills, seed=config.seed)
    loss.load_state_dict(torch.load(path, weights_only=True))
    return SkillPolicy(loss.actor_network, deterministic=True)


def run(config: LabMazeConfig, args: argparse.Namespace, parts: Parts) -> None:
    """Measure everything with DIAYN's worker of one seed."""
    key = f"{config.algorithm} {config.seed}"
    worker = trained(config, parts, args.work)

    def solve(size: int, config: LabMazeConfig = config) -> dict[str, Any]:
        mazes = args.mazes if size <= 15 else args.large_mazes
        return solve_mazes(config, worker, size=size, mazes=mazes)

    for size in args.sizes:
        parts(f"{key} size {size}", lambda size=size: solve(size))
    for name, real in list(wrong_models(ERROR).items())[: args.wrong_models]:
        parts(
            f"{key} wrong model, {name}",
            lambda real=real: solve_with_wrong_model(config, worker, mazes=args.mazes, **real),
        )
    fixed = dataclasses.replace(config, stall_steps=0)
    parts(f"{key} fixed length, size 9", lambda: solve(9, fixed))


def compare(config: LabMazeConfig, args: argparse.Namespace, parts: Parts, name: str) -> None:
    """Measure another way of training in the 9 x 9 mazes."""
    worker = trained(config, parts, args.work, name)
    parts(f"{name} size 9", lambda: solve_mazes(config, worker, size=9, mazes=args.mazes))


def table(results: dict[str, Any]) -> str:
    """The figures in Markdown."""
    lines = [
        "| worker, seed, mazes | solved at the first trial | frames to the goal, mean | script "
        "| ratio | simulated frames, mean | expansions, mean (max) | planning, CPU s a maze |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, x in results.items():
        if " size " in name:
            lines.append(
                f"| {name} | {x['solved']} of {x['mazes']} | {x['frames']['mean']:,.0f} | "
                f"{x['script_frames']['mean']:,.0f} | {x['frames_over_script']:.2f} | "
                f"{x['simulated_frames']['mean']:,.0f} | "
                f"{x['expansions']['mean']:,.0f} ({x['expansions_max']:,}) | "
                f"{x['plan_cpu_seconds']['mean']:.2f} |"
            )
    lines += [
        "",
        "| worker, seed, real env | solved by planning again | by the first plan alone "
        "| frames, mean | plans, mean |",
        "|---|---|---|---|---|",
    ]
    for name, x in results.items():
        if "wrong model" in name:
            lines.append(
                f"| {name} | {x['solved']} of {x['mazes']} | {x['solved_by_the_first_plan']} | "
                f"{x['frames']['mean']:,.0f} | {x['num_plans']['mean']:.1f} |"
            )
    return "\n".join(lines)


def _short(result: dict[str, Any]) -> str:
    shown = ("solved", "mazes", "solved_by_the_first_plan", "frames_over_script", "base_steps")
    return ", ".join(f"{key} {result[key]}" for key in shown if key in result)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--mazes", type=int, default=200, help="test mazes of up to 15 x 15")
    parser.add_argument("--sizes", type=int, nargs="+", default=[9, 15, 31])
    parser.add_argument("--large-mazes", type=int, default=40, help="test mazes of larger sizes")
    parser.add_argument("--wrong-models", type=int, default=4, help="of four, two signs each")
    parser.add_argument("--out", type=Path, default=Path("labmaze.json"))
    parser.add_argument("--work", type=Path, default=Path("runs/labmaze_benchmark"))
    parser.add_argument("--quick", action="store_true", help="one seed, one size, 20 mazes")
    args = parser.parse_args()
    if args.quick:
        args.seeds, args.sizes, args.mazes, args.wrong_models = args.seeds[:1], [9], 20, 2
    torch.set_num_threads(1)
    known = ("seeds", "out", "work")  # more seeds may join what is there
    parts = Parts(args.out, {k: v for k, v in vars(args).items() if k not in known})
    configs = [LabMazeConfig(seed=seed) for seed in args.seeds]
    for config in configs:
        run(config, args, parts)
    for config in configs:
        rounds = dataclasses.replace(config, algorithm="hmcts")
        compare(rounds, args, parts, f"hmcts {config.seed}")
        longer = dataclasses.replace(config, train_frames=160_000, updates_per_step=3 / 64)
        compare(longer, args, parts, f"diayn-160k {config.seed}")
    for kind, title in (("diayn", "DIAYN"), ("hmcts", "Algorithm 3")):
        curves = [parts.results[f"{kind} {c.seed} training"]["curve"] for c in configs]
        script = float(np.mean([curve_script_frames(config) for config in configs]))
        plot_training(
            {title: curves},
            solving_panels(script),
            args.out.with_name(f"{args.out.stem}_{kind}.png"),
            title=f"{title}: {configs[0].curve_mazes} held-out mazes of 9 x 9, "
            + (f"{len(curves)} seeds (mean, range)" if len(curves) > 1 else "one seed"),
            x_label="frames of training",
        )
    print(table(parts.results))


if __name__ == "__main__":
    sys.exit(main())
