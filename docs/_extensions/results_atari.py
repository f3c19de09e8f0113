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
    "who acts",
    "mean",
    "least to largest",
    "episodes",
    "simulated steps per real one",
    "emulated frames, all kinds",
    "options from",
    "options x base steps",
    "seed",
]


def _range(run: dict[str, Any]) -> str:
    scores = [episode["score"] for episode in run["episodes"]]
    old = "" if "score_min" in run else ", old rule"
    return f"{min(scores):g} to {max(scores):g}{old}"


def simulated_per_real(run: dict[str, Any]) -> float:
    """Return the simulated steps per real one of a run's episodes."""
    real = sum(episode["real_frames"] for episode in run["episodes"])
    spent = run["frames"] - run["frames_finding_options"] - run["frames_tuning"]
    return float((spent - real) / real)


def learned(data: dict[str, Any]) -> str:
    """Return a table of learned workers and what they are compared with, means over seeds."""
    rows = []
    for game, source in dict.fromkeys((r["game"], r["source"]) for r in data["rows"]):
        runs = [r for r in data["rows"] if (r["game"], r["source"]) == (game, source)]
        scores = [score for run in runs for score in run["scores"]]
        means = ", ".join(f"{run['score_mean']:g}" for run in runs)
        per_real = sum(run["simulated_per_real"] for run in runs) / len(runs)
        steps = sum(run["frames_finding_options"] for run in runs) / len(runs) / 4
        row = [game, source, runs[0]["acts"], len(runs), f"{sum(scores) / len(scores):.1f}"]
        row += [means, f"{min(scores):g} to {max(scores):g}", f"{per_real:.1f}", f"{steps:,.0f}"]
        rows.append(row)
    head = [
        "game", "options from", "who acts", "seeds", "mean of all episodes", "mean of each seed",
        "least to largest", "simulated steps per real one", "base steps of learning",
    ]  # fmt: skip
    budget = ", ".join(f"{key}={value:g}" for key, value in data["budget"].items())
    return (
        f"Ten test episodes for each seed, cut short; the worker learns without any rule but where "
        f"FIRE is forced (`fire`), options are as many and as long as in Table 5.1, no setting was "
        f"chosen by a score. {budget}.\n\n" + table(head, rows)
    )


def atari(runs: Sequence[dict[str, Any]]) -> str:
    """Return a table for each protocol."""
    text = (
        "The dissertation reports the highest score within 10 million time steps (40 million "
        "frames) of an agent whose worker is a learned network. Ours is the mean of a run's "
        "episodes; rules act, but where the table says network. All emulated frames count: real, "
        "simulated, and those spent on finding options. Runs without an entry `score_min` were "
        "made under the old rule, by which options were chosen on starts that are scored, too.\n"
    )
    for protocol in ("deterministic", "sticky"):
        rows = [
            [
                game,
                score,
                baseline,
                run.get("acts", "rules"),
                run["score_mean"],
                _range(run),
                len(run["episodes"]),
                f"{simulated_per_real(run):.1f}",
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


def sticky(data: dict[str, Any]) -> str:
    """Return the sticky protocol's tables: scores at numbers of frames, and who plays alone."""
    checkpoints = [str(frames) for frames in data["dopamine"]["frames"]]
    rows = [
        [
            row["game"],
            row["seed"],
            *(f"{row['score_at'][at]:.1f}" if at in row["score_at"] else "-" for at in checkpoints),
            *(_mean(row.get(f"reactive_{name}")) for name in ("sticky", "deterministic")),
            f"{row['frames_before_first_episode'] / row['frames']:.1%}",
            f"{row['frames'] / 1e6:.1f} million",
        ]
        for row in data["rows"]
    ]
    named = [f"{int(at) // 1_000_000}M frames" for at in checkpoints]
    head = ["game", "seed", *named, "without search", "the same, deterministic",
            "frames before the first episode", "frames, all kinds"]  # fmt: skip
    means = [[name, *values] for name, values in data["dopamine"]["interquartile_mean"].items()]
    ours: dict[str, str] = {}
    for line in data["summary"]:
        if len(line["games"]) == len(TABLE_5_1):
            seeds, low_high = min(line["seeds"]), line["interval_95"]
            interval = f" ({low_high[0]:.2f} to {low_high[1]:.2f})" if low_high else ""
            ours[str(line["frames"])] = (
                f"{line['interquartile_mean']:.2f}{interval}, {seeds} seed(s)"
            )
    means.append(["ours, seven games", *(ours.get(at, "-") for at in checkpoints)])
    return (
        "Actions stick with probability 0.25; episodes are played to their end or 108,000 frames; "
        "every emulated frame counts. A score is the mean of the last ten planned episodes that "
        "were over by then, or of all, where there are fewer. **The simulator is set** to plan; "
        "Dopamine's agents never set theirs.\n\n"
        + table(head, rows)
        + "\nInterquartile means of human-normalised scores, beside Dopamine's published training "
        "curves of five runs:\n\n" + table(["agent", *named], means)
    )


def _mean(scores: Sequence[float] | None) -> str:
    return "-" if not scores else f"{sum(scores) / len(scores):.1f}"


def best(runs: Sequence[dict[str, Any]], game: str) -> str:
    """Return the best deterministic score in a game, or that there is none."""
    scores = [
        run["score_max"]
        for run in runs
        if run["game"] == game and run["protocol"] == "deterministic"
    ]
    return f"{max(scores):,.0f}" if scores else "not measured yet"
