"""Results of Atari runs: what is kept of each, and their scores normalised by humans'.

    python benchmarks/atari_results.py runs/* --out docs/results/atari

Reads the folders that ``hmcts train experiment=atari`` has written, finished ones; runs nothing.
What ``--out`` has already is kept, but for runs of the same game, protocol, source, seed and ratio.
Protocols and sources of options are never mixed: a row is a game, a protocol and a source. The
interquartile mean over games and seeds is given with a stratified bootstrap interval of 95 %
(Agarwal et al. 2021).
"""

from __future__ import annotations

import argparse
import json
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.figures.atari_scores import (
    RUNNING,
    TABLE_5_1,
    aggregate,
    best_source,
    human_normalised,
)
from torchrl_hmcts.trainers.saving.run_folder import read_curves

UCT_SOURCE = "primitive actions, UCT"
BEST = "the best of each game"
KEPT = (
    "game", "protocol", "source", "acts", "seed", "score_mean", "score_min", "score_max",
    "score_final", "episodes", "simulated_per_real", "frames", "base_steps", "options",
    "option_steps", "c", "frames_finding_options", "frames_tuning",
    "frames_per_decision", "seconds", "finding", "tuning",
)  # fmt: skip
SETTINGS = (
    "ratio", "tree_policy", "rollout_options", "gamma", "width_novelty", "leaves_per_wave",
    "max_episode_frames", "option_steps",
)  # fmt: skip


def read(folder: Path) -> dict[str, Any] | None:
    """What is kept of a run; None if it is not finished."""
    path = folder / "metrics.json"
    if not path.is_file():
        return None
    metrics = json.loads(path.read_text())
    row = {key: metrics[key] for key in KEPT if key in metrics}
    config = metrics["config"]
    row["settings"] = {key: config[key] for key in SETTINGS if key in config}
    words = [f"{k}={v}" for k, v in sorted(config.items()) if k not in ("out", "resume")]
    row["command"] = "hmcts train experiment=atari " + " ".join(w for w in words if w[-1] != "=")
    row["versions"] = metrics["versions"]
    guide = config.get("guide", "none")
    if guide not in ("none", row["source"].rpartition("=")[2]):
        row["source"] += f", guide={guide}"
    if config.get("width_novelty"):
        row["source"] += ", width_novelty"
    if row["settings"].get("tree_policy", "puct") == "uct":
        row["source"] = UCT_SOURCE
    curves = read_curves(folder)
    row["curves"] = {
        name: {"step": thin(curves[name].steps), "value": thin(curves[name].values)}
        for name in ("score", "score_max", RUNNING)
        if name in curves
    }
    return row


def thin(values: Sequence[float], most: int = 150) -> list[float]:
    """At most so many of the values, evenly spread, the last among them."""
    every = -(-len(values) // most)
    return list(values[::-1][::every][::-1]) if every else []


def dumps(content: Any) -> str:
    """JSON with a line for each entry, and one for each list of numbers."""
    text = json.dumps(content, indent=1)
    return re.sub(r"\[[-+.,\deE\s]+\]", lambda m: " ".join(m[0].split()), text)


def key_of(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """What makes a run the same as another."""
    return *(row[key] for key in ("game", "protocol", "source", "seed")), row["settings"]["ratio"]


def add_known(rows: list[dict[str, Any]], path: Path) -> list[dict[str, Any]]:
    """The rows and those of an earlier call that they do not replace, in order."""
    known = json.loads(path.read_text()) if path.is_file() else []
    new = {key_of(row) for row in rows}
    every = rows + [row for row in known if key_of(row) not in new]
    return sorted(every, key=lambda row: tuple(map(str, key_of(row))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--out", type=Path, help="folder")
    args = parser.parse_args()
    rows = [row for row in map(read, args.runs) if row is not None]
    # What is compared with has a folder of its own: figures 5.1 to 5.7 show ours.
    ours = [row for row in rows if row["source"] != UCT_SOURCE]
    others = [row for row in rows if row["source"] == UCT_SOURCE]
    if args.out is not None:
        ours = add_known(ours, args.out / "runs.json")
        others = add_known(others, args.out / "compared" / "uct.json")
        rows = ours + others
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[row["protocol"], row["source"]].append(row)
    for protocol in sorted({row["protocol"] for row in rows}):
        for game in TABLE_5_1:
            of = [row for row in ours if (row["game"], row["protocol"]) == (game, protocol)]
            groups[protocol, BEST] += best_source(of)
    summary = []
    for (protocol, source), members in sorted(groups.items()):
        games = sorted({row["game"] for row in members})
        for key in ("score_mean", "score_max"):
            scores = [[human_normalised(r, key) for r in members if r["game"] == g] for g in games]
            middle, *interval = (round(value, 3) for value in aggregate(scores))
            row = {"protocol": protocol, "source": source, "of": key, "games": games}
            row["interquartile_mean_human_normalised"] = middle
            # One run of a game tells nothing about others of it.
            row["interval_95"] = interval if min(map(len, scores)) > 1 else None
            summary.append(row)
    for line in summary:
        print(json.dumps(line))
    if args.out is not None:
        command = "python benchmarks/atari_results.py runs/* --out docs/results/atari"
        for path, content in (
            (args.out / "runs.json", ours),
            (args.out / "compared" / "uct.json", others),
            (args.out / "summary.json", {"command": command, "summary": summary}),
        ):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(dumps(content) + "\n")


if __name__ == "__main__":
    main()
