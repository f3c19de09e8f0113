"""Chapter 5's tables, from the runs in ``docs/results/atari``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from results_tables import table

from torchrl_hmcts.trainers.figures.atari_scores import TABLE_5_1, best_baseline


def _baseline(game: str) -> str:
    name, score = best_baseline(game)
    return f"{score:.0f} ({name})" if score >= 100 else f"{score:.1f} ({name})"


# Dissertation, table 5.1 and table A.1 (mean of the best of seven algorithms of OpenAI Baselines).
ATARI = [
    (game, row.score, row.num_skills, row.option_steps, _baseline(game))
    for game, row in TABLE_5_1.items()
]
_HEAD = [
    "game",
    "table 5.1",
    "best of table A.1",
    "best episode",
    "last",
    "episodes",
    "emulated frames, all kinds",
    "options from",
    "options x base steps",
    "seed",
]


def atari(runs: Sequence[dict[str, Any]]) -> str:
    """Return a table for each protocol."""
    text = (
        "The dissertation reports the highest score within 10 million time steps (40 million "
        "frames). Here all emulated frames count: real, simulated, and those spent on finding "
        "options.\n"
    )
    for protocol in ("deterministic", "sticky"):
        rows = [
            [
                game,
                score,
                baseline,
                run["score_max"],
                run["score_final"],
                len(run["episodes"]),
                f"{run['frames'] / 1e6:.2f} million",
                run["source"],
                f"{len(run['options'])} x {run['option_steps']}",
                run["seed"],
            ]
            for game, score, _, _, baseline in ATARI
            for run in runs
            if run["game"] == game and run["protocol"] == protocol
        ]
        if rows:
            text += f"\nProtocol: {protocol}\n\n" + table(_HEAD, rows)
    return text


def sources(data: dict[str, Any]) -> str:
    """Return a table of every source of options, game by game under both protocols."""
    rows = data["rows"]
    games = sorted({row["game"] for row in rows})
    names = list(dict.fromkeys(row["source"] for row in rows))
    protocols = ("deterministic", "sticky")

    def cell(source: str, game: str, protocol: str) -> str:
        found = [
            r for r in rows if (r["source"], r["game"], r["protocol"]) == (source, game, protocol)
        ]
        # An episode that would continue is cut off: it might have scored more.
        return ", ".join(f"{r['score']:g}{'' if r['ended'] else '+'}" for r in found) or "-"

    table_rows = []
    for name in names:
        spent = [r["frames_finding_options"] for r in rows if r["source"] == name]
        cells = [cell(name, game, p) for game in games for p in protocols]
        table_rows.append([name, *cells, f"{max(spent) / 1e6:.2f} million"])
    head = [f"{game}, {p}" for game in games for p in protocols]
    text = (
        f"One planned episode each, cut off after {data['real_steps']:,} base steps (then marked "
        f"+), {data['ratio']:g} simulated base steps per real one, options of "
        f"{data['option_steps']} base steps, {data['base_steps']:,} base steps to train a network, "
        f"seed {data['seed']}. Last column: the most frames that finding the options took.\n"
    )
    return text + "\n" + table(["options from", *head, "frames for finding"], table_rows)


def best(runs: Sequence[dict[str, Any]], game: str) -> str:
    """Return the best deterministic score in a game, or that there is none."""
    scores = [
        run["score_max"]
        for run in runs
        if run["game"] == game and run["protocol"] == "deterministic"
    ]
    return f"{max(scores):,.0f}" if scores else "not measured yet"
