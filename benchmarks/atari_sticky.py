"""Sticky Atari as the field plays it: every frame counted, whole episodes, beside Dopamine.

    python benchmarks/atari_sticky.py --games Pong Breakout --seeds 0 --frames 10_000_000

Each game and seed is a run of ``hmcts train experiment=atari protocol=sticky`` in a folder of its
own under ``--runs``; what is there is resumed, so it can be stopped at any time. A finished run's
manager then plays ten episodes more without search in each protocol. With ``--collect`` nothing is
run: what there is, finished or not, becomes ``sticky.json`` and a figure.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig
from torchrl_hmcts.trainers.experiments.atari.episodes import CHECKPOINTS, load_run, score_at
from torchrl_hmcts.trainers.experiments.atari.run import run_atari
from torchrl_hmcts.trainers.figures.atari_figures import plot_sticky
from torchrl_hmcts.trainers.figures.atari_scores import TABLE_5_1, aggregate, human_normalised
from torchrl_hmcts.trainers.saving.files import write_json

DOPAMINE = {  # interquartile means of its published training curves, by frames
    "DQN": (0.01, 0.10, 0.30, 0.60),
    "Rainbow": (0.02, 0.24, 0.65, 1.06),
    "IQN (Impala network)": (0.25, 0.63, 0.92, 2.26),
    "Rainbow (Impala)": (0.06, 0.62, 0.99, 2.22),
}


def play(game: str, seed: int, args: argparse.Namespace) -> None:
    """Run a game and seed to its end, then its manager without search."""
    keys: dict[str, Any] = {"game": game, "seed": seed, "num_processes": 0}
    folder = args.runs / f"{game}_{seed}"
    if not (folder / "metrics.json").is_file():
        resume = (folder / "checkpoints").is_dir()
        keys_of_run = {"protocol": "sticky", "frames": args.frames, "resume": resume}
        run_atari(AtariConfig(**keys, **keys_of_run, out=str(folder)))
    for protocol in ("sticky", "deterministic"):
        out = args.runs / f"{game}_{seed}_reactive_{protocol}"
        if not (out / "metrics.json").is_file():
            alone = {"guide": "reactive", "ratio": 0.0, "practice": 0.0, "overwrite": True}
            source = {"protocol": protocol, "options_from": str(folder), "out": str(out)}
            run_atari(AtariConfig(**keys, **alone, **source))


def read(folder: Path) -> dict[str, Any]:
    """What is kept of a run, finished or not."""
    state = load_run(folder)[1]
    config, episodes = state["config"], state["scores"]
    row: dict[str, Any] = {name: config[name] for name in ("game", "seed", "ratio", "practice")}
    row["frames"] = state["frames"]
    row["frames_finding_options"] = state["options"]["num_frames"]
    row["options"], row["option_steps"] = state["options"]["names"], state["tuned"]["option_steps"]
    row["practised"] = state["agent"]["guide"]["practised"]
    row["finished"] = (folder / "metrics.json").is_file()
    row["score_at"] = score_at(episodes)
    kept = ("frames", "score", "real_frames", "guided")
    row["episodes"] = [{key: e[key] for key in kept} for e in episodes]
    for protocol in ("sticky", "deterministic"):
        metrics = folder.with_name(f"{folder.name}_reactive_{protocol}") / "metrics.json"
        if metrics.is_file():
            scores = [e["score"] for e in json.loads(metrics.read_text())["episodes"]]
            row[f"reactive_{protocol}"] = sum(scores) / len(scores)
            row[f"reactive_{protocol}_scores"] = scores
    return row


def collect(args: argparse.Namespace) -> None:
    """Write what there is."""
    files = args.runs.glob("*_[0-9]/checkpoints/checkpoint-*")
    folders = sorted({path.parents[1] for path in files})
    rows = [read(folder) for folder in folders]
    summary = []
    for frames in map(str, CHECKPOINTS):
        there = [
            {**row, "score": row["score_at"][frames]} for row in rows if frames in row["score_at"]
        ]
        games = [game for game in TABLE_5_1 if any(row["game"] == game for row in there)]
        if not games:
            continue
        scores = [[human_normalised(r, "score") for r in there if r["game"] == g] for g in games]
        middle, *interval = (round(value, 3) for value in aggregate(scores))
        several = min(map(len, scores)) > 1
        line = {"frames": int(frames), "games": games, "seeds": [len(seeds) for seeds in scores]}
        summary.append(
            {**line, "interquartile_mean": middle, "interval_95": interval if several else None}
        )
        print(json.dumps(summary[-1]))
    content = {
        "command": "python benchmarks/atari_sticky.py --seeds 0 --frames N, N as `frames` of a row",
        "dopamine": {"frames": CHECKPOINTS, "interquartile_mean": DOPAMINE},
        "summary": summary,
        "rows": rows,
    }
    write_json(args.out / "sticky.json", content)
    plot_sticky(rows, args.out / "sticky.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--games", nargs="+", default=list(TABLE_5_1), choices=list(TABLE_5_1))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--frames", type=int, default=10_000_000)
    parser.add_argument("--runs", type=Path, default=Path("runs/atari_sticky"))
    parser.add_argument("--out", type=Path, default=Path("docs/results/atari"))
    parser.add_argument("--collect", action="store_true")
    args = parser.parse_args()
    for seed in [] if args.collect else args.seeds:
        for game in args.games:
            play(game, seed, args)
    collect(args)


if __name__ == "__main__":
    main()
