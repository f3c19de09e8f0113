"""DeepMind Lab's random maze: what the experiment of chapter 4 gives, over several seeds.

    python benchmarks/labmaze.py --seeds 0 1 2 --out docs/results/lab/labmaze.json
    python benchmarks/labmaze.py --quick

For each seed, a worker is trained by DIAYN in 40,000 frames (10,000 base steps) of 9 x 9 mazes, and
then mazes of all sizes are solved with it, each at the first trial: a plan in the model, executed
in another instance of the env. Further, in the 9 x 9 mazes: options of fixed length; envs whose
clock and friction differ by 5 % from the model's, with a new plan after every option; workers of
Algorithm 3 from scratch, and of DIAYN with 40,000 base steps (160,000 frames).

Every part is written to ``--out`` as soon as it is known, and the workers to ``--work``; started
again with the same arguments, the script continues with what is missing.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from table import markdown, read_arguments

from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.trainers.experiments.kits.lab import LabMazeKit, wrong_models
from torchrl_hmcts.trainers.experiments.settings import LabMazeConfig
from torchrl_hmcts.trainers.experiments.skills import learn, make_loss, solve
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

    kit = LabMazeKit(config)

    def train() -> dict[str, Any]:
        worker = learn(kit)
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(worker.loss.state_dict(), path)
        return {
            "frames": worker.steps * config.frames_per_step,
            "base_steps": worker.steps,
            "rounds": worker.rounds,
            "cpu_seconds": worker.seconds,
            "curve": kit.frames_curve(worker.tests),
        }

    parts(f"{name} training", train)
    loss = make_loss(kit)
    loss.load_state_dict(torch.load(path, weights_only=True))
    return SkillPolicy(loss.actor_network, deterministic=True)


def solved(config: LabMazeConfig, worker: SkillPolicy, **changes: Any) -> dict[str, Any]:
    """First trials with some keys changed."""
    kit = LabMazeKit(dataclasses.replace(config, **changes))
    return kit.figures(solve(kit, worker))


def run(config: LabMazeConfig, args: argparse.Namespace, parts: Parts) -> None:
    """Measure everything with DIAYN's worker of one seed."""
    key = f"{config.algorithm} {config.seed}"
    worker = trained(config, parts, args.work)
    for size in args.sizes:
        mazes = args.mazes if size <= 15 else args.large_mazes
        parts(
            f"{key} size {size}",
            lambda size=size, mazes=mazes: solved(config, worker, size=size, mazes=mazes),
        )
    kit = LabMazeKit(config)
    for name, real in list(wrong_models(ERROR).items())[: args.wrong_models]:
        parts(
            f"{key} wrong model, {name}",
            lambda real=real: kit.solve_with_wrong_model(worker, args.mazes, **real),
        )
    parts(
        f"{key} fixed length, size 9",
        lambda: solved(config, worker, size=9, mazes=args.mazes, stall_steps=0),
    )


def compare(config: LabMazeConfig, args: argparse.Namespace, parts: Parts, name: str) -> None:
    """Measure another way of training in the 9 x 9 mazes."""
    worker = trained(config, parts, args.work, name)
    parts(f"{name} size 9", lambda: solved(config, worker, size=9, mazes=args.mazes))


def table(results: dict[str, Any]) -> str:
    """The figures in Markdown."""
    solved = {
        "worker, seed, mazes": lambda row: row[0],
        "solved at the first trial": lambda row: f"{row[1]['solved']} of {row[1]['mazes']}",
        "frames to the goal, mean": lambda row: f"{row[1]['frames']['mean']:,.0f}",
        "script": lambda row: f"{row[1]['script_frames']['mean']:,.0f}",
        "ratio": lambda row: f"{row[1]['frames_over_script']:.2f}",
        "simulated frames, mean": lambda row: f"{row[1]['simulated_frames']['mean']:,.0f}",
        "expansions, mean (max)": lambda row: (
            f"{row[1]['expansions']['mean']:,.0f} ({row[1]['expansions_max']:,})"
        ),
        "planning, CPU s a maze": lambda row: f"{row[1]['plan_cpu_seconds']['mean']:.2f}",
    }
    wrong = {
        "worker, seed, real env": lambda row: row[0],
        "solved by planning again": lambda row: f"{row[1]['solved']} of {row[1]['mazes']}",
        "by the first plan alone": lambda row: row[1]["solved_by_the_first_plan"],
        "frames, mean": lambda row: f"{row[1]['frames']['mean']:,.0f}",
        "plans, mean": lambda row: f"{row[1]['num_plans']['mean']:.1f}",
    }
    sizes = [row for row in results.items() if " size " in row[0]]
    models = [row for row in results.items() if "wrong model" in row[0]]
    return f"{markdown(sizes, solved)}\n\n{markdown(models, wrong)}"


def _short(result: dict[str, Any]) -> str:
    shown = ("solved", "mazes", "solved_by_the_first_plan", "frames_over_script", "base_steps")
    return ", ".join(f"{key} {result[key]}" for key in shown if key in result)


def main() -> None:
    args = read_arguments(
        __doc__,
        {"seeds": [0], "sizes": [9], "mazes": 20, "wrong_models": 2},
        seeds=[0, 1, 2],
        mazes=(200, "test mazes of up to 15 x 15"),
        sizes=[9, 15, 31],
        large_mazes=(40, "test mazes of larger sizes"),
        wrong_models=(4, "of four, two signs each"),
        work="runs/labmaze_benchmark",
    )
    args.out, args.work = args.out or Path("labmaze.json"), Path(args.work)
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
        script = float(np.mean([LabMazeKit(config).script_frames() for config in configs]))
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
    main()
