"""Learned workers and rules compared: the same budget, search and scored episodes for all.

    python benchmarks/atari_sources.py --games Pong Breakout --sources diayn_retrained repeat

Each game, source and seed is a run of ``hmcts train experiment=atari`` in a folder of its own
under ``--runs``; one that is finished is not run again, so that it can be stopped. Options are as
many and as long as in the dissertation's Table 5.1; no setting is chosen by a score. Episodes are
cut short to make it cheap: compare rows with each other only. With ``--collect`` nothing is run:
what there is becomes ``learned.json`` and a figure of the learning curves for each game.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any

from atari_results import read

from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig
from torchrl_hmcts.trainers.experiments.atari.run import run_atari
from torchrl_hmcts.trainers.figures.atari_figures import plot_learning
from torchrl_hmcts.trainers.figures.atari_scores import TABLE_5_1
from torchrl_hmcts.trainers.saving.files import write_json

BUDGET = {
    "ratio": 10.0, "episodes": 10, "max_episode_frames": 2_000, "skill_base_steps": 20_000,
    "rounds": 4, "trial_steps": 500, "trial_ratio": 10.0, "num_processes": 0,
}  # fmt: skip
CURVE = {"curve_every": 10_000, "curve_steps": 300}


def make_config(game: str, source: str, seed: int, args: argparse.Namespace) -> AtariConfig:
    """The run of a row; "untrained" is a network as it was made."""
    theirs = TABLE_5_1[game]
    settings: dict[str, Any] = {**BUDGET, "option_steps": theirs.option_steps}
    settings["num_skills"] = theirs.num_skills
    if source == "untrained":
        settings["skill_base_steps"] = 1
    elif source in args.curves:
        settings |= CURVE
    if source not in ("untrained", "diayn", "diayn_retrained"):
        settings["fire"] = 0.05  # a rule of ours: the dissertation's worker has none
    name = "diayn" if source == "untrained" else source.removesuffix("_game")
    if source.endswith("_game"):  # rewarded by the game, too
        settings |= {"game_weight": 10.0, "skill_base_steps": 60_000}
    out = str(args.runs / f"{game}_{source}_{seed}")
    return AtariConfig(game=game, source=name, seed=seed, out=out, overwrite=True, **settings)


def collect(args: argparse.Namespace) -> None:
    """Write what there is, and draw the learning curves."""
    rows = []
    for folder in sorted(args.runs.iterdir()):
        if (row := read(folder)) is None:
            continue
        rows.append(row)
        row["source"] = folder.name.removeprefix(row["game"] + "_").rpartition("_")[0]
        row["learning"] = row.pop("finding").get("learning", {})
        row["scores"] = [episode["score"] for episode in row.pop("episodes")]
        del row["curves"], row["tuning"]
    command = "python benchmarks/atari_sources.py"
    write_json(args.out / "learned.json", {"command": command, "budget": BUDGET, "rows": rows})
    curves: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        if points := row["learning"].get("rows"):
            curves[row["game"]][row["source"]].append(points)
    for game, workers in curves.items():
        named = {f"{name}, {len(seeds)} seeds": seeds for name, seeds in workers.items()}
        plot_learning(named, args.out / f"learning_{game}.png", title=game)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--games", nargs="+", default=["Pong", "Breakout", "SpaceInvaders"])
    parser.add_argument(
        "--sources", nargs="+",
        default=["diayn_retrained", "diayn_displacement_retrained",
                 "diayn_controllable_retrained", "metra_retrained", "untrained", "repeat"],
    )  # fmt: skip
    parser.add_argument("--curves", nargs="*", default=["diayn_retrained"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--runs", type=Path, default=Path("runs/atari_sources"))
    parser.add_argument("--out", type=Path, default=Path("docs/results/atari"))
    parser.add_argument("--collect", action="store_true")
    args = parser.parse_args()
    for seed in [] if args.collect else args.seeds:
        for source in args.sources:
            for game in args.games:
                config = make_config(game, source, seed, args)
                if not (Path(config.out) / "metrics.json").is_file():
                    run_atari(config)
    collect(args)


if __name__ == "__main__":
    main()
