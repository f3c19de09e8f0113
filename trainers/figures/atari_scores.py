"""Chapter 5: scores in seven games beside the dissertation's (Tables 5.1 and A.1).

Files in ``docs/results/atari`` are lists of the ``metrics.json`` of runs, with an entry ``curves``.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrl_hmcts.trainers.figures.curves import legend_of_all, style
from torchrl_hmcts.trainers.figures.intervals import bootstrap, interquartile_mean
from torchrl_hmcts.trainers.figures.pages import Cell, Section, Table, plain, write_sections
from torchrl_hmcts.trainers.figures.pictures import COLORS, save_figure
from torchrl_hmcts.trainers.saving.files import write_text
from torchrl_hmcts.trainers.saving.run_folder import RunCurve, RunFolder

Row = Mapping[str, Any]
"""Summary of a run."""
_FEW = 30
RUNNING = "score_of_the_running_episode"
"""The curve of the running score."""


@dataclass(frozen=True)
class SourceScore:
    """A row of the dissertation's Table 5.1.

    ``score`` is the highest of training; ``num_skills`` its N_policies and ``option_steps`` its
    N_worker_samples, found by grid search.
    """

    score: int
    num_skills: int
    option_steps: int


TABLE_5_1 = {
    "BeamRider": SourceScore(6823, 3, 20),
    "Breakout": SourceScore(464, 3, 30),
    "Enduro": SourceScore(708, 4, 20),
    "SpaceInvaders": SourceScore(1343, 4, 30),
    "Qbert": SourceScore(19839, 5, 10),
    "Seaquest": SourceScore(1904, 5, 10),
    "Pong": SourceScore(20, 3, 10),
}
"""The dissertation's Table 5.1, by game."""

# Human and random scores as in dqn_zoo's atari_data.py.
HUMAN_AND_RANDOM = {
    "BeamRider": (16926.5, 363.9),
    "Breakout": (30.5, 1.7),
    "Enduro": (860.5, 0.0),
    "SpaceInvaders": (1668.7, 148.0),
    "Qbert": (13455.0, 163.9),
    "Seaquest": (42054.7, 68.4),
    "Pong": (14.6, -20.7),
}
"""Scores that count as 1 and 0 where scores are normalised, by game."""

_A_1_GAMES = ("Enduro", "SpaceInvaders", "Qbert", "Seaquest", "Pong", "BeamRider", "Breakout")
TABLE_A_1 = {
    algorithm: dict(zip(_A_1_GAMES, scores, strict=True))
    for algorithm, scores in {
        "ppo2": (350.22, 557.28, 7012.06, 1218.87, 13.68, 1299.25, 114.26),
        "deepq": (479.75, 459.86, 3254.83, 1164.08, 16.49, 1582.34, 131.46),
        "acktr": (0.0, 557.19, 4429.3, 1201.16, 9.56, 2171.19, 113.58),
        "acer": (0.0, 656.91, 6433.38, 1065.98, 3.11, 1959.22, 82.94),
        "ppo2_mpi": (207.47, 459.89, 7184.73, 1383.38, 13.9, 594.45, 81.61),
        "a2c": (0.0, 463.06, 2047.07, 1150.66, 1.0, 1302.61, 59.72),
        "trpo_mpi": (24.83, 457.7, 2486.18, 710.07, 2.82, 683.11, 14.98),
    }.items()
}
"""The dissertation's Table A.1: mean scores of OpenAI Baselines after 10M steps, by algorithm."""


def best_baseline(game: str) -> tuple[str, float]:
    """Return the best algorithm of Table A.1 in a game, and its mean score."""
    return max(((name, row[game]) for name, row in TABLE_A_1.items()), key=lambda pair: pair[1])


def read_scores(runs: Sequence[RunFolder], results: Path | None) -> list[dict[str, Any]]:
    """Return the summaries of the runs given, else those of the measured results."""
    rows = [
        {**run.config, **run.metrics, "curves": run.curves}
        for run in runs
        if "game" in {**run.config, **run.metrics}
    ]
    for file in sorted(results.glob("*.json")) if results is not None and not rows else []:
        content = json.loads(file.read_text(encoding="utf-8"))
        for row in content if isinstance(content, list) else []:
            curves = {
                name: RunCurve(name, curve["step"], curve["value"], "steps")
                for name, curve in row.get("curves", {}).items()
            }
            rows.append({**row, "curves": curves})
    return rows


def by_protocol(rows: Sequence[Row], game: str) -> dict[str, list[Row]]:
    """Return the summaries of a game, by protocol."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        if row.get("game") == game:
            groups.setdefault(str(row.get("protocol", "deterministic")), []).append(row)
    return groups


def human_normalised(row: Row, key: str) -> float:
    """Return a run's score in units of what a human scores more than random play.

    Reference:
        Mnih et al., "Human-level control through deep reinforcement learning", 2015.
    """
    human, random = HUMAN_AND_RANDOM[row["game"]]
    return float((row[key] - random) / (human - random))


def aggregate(scores: Sequence[Sequence[float]]) -> tuple[float, float, float]:
    """Return the interquartile mean over games and seeds with its stratified 95 % interval.

    Each game counts as much as another, however many seeds it has: ``scores`` are human-normalised,
    of the seeds of each game.

    Reference:
        Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
        2021, arXiv 2108.13264.
    """
    generator = np.random.default_rng(0)
    often = math.lcm(*map(len, scores))

    def mean(samples: Sequence[np.ndarray]) -> Any:
        equal = [game.repeat(often // game.shape[-1], -1) for game in samples]
        return interquartile_mean(np.concatenate(equal, -1))

    means = mean([generator.choice(np.array(g), size=(5_000, len(g))) for g in scores])
    middle = float(mean([np.array(g) for g in scores]))
    low, high = np.percentile(means, [2.5, 97.5])
    return middle, float(low), float(high)


def best_source(rows: Sequence[Row]) -> list[Row]:
    """Return the runs of the source of options with the highest mean score of a run of a game."""
    if not rows:
        return []
    winner = max(rows, key=lambda row: float(row.get("score_mean", float("-inf"))))
    return [row for row in rows if row.get("source") == winner.get("source")]


def over_seeds(
    curves: Sequence[RunCurve], *, from_start: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Bring curves that begin and end at different steps together.

    Returns steps ``[G]`` and values ``[S, G]``, NaN where a seed does not count. A seed counts from
    its first value on, since looking for options takes some longer than others, and keeps its last
    value to the end; with ``from_start``, steps count from the first of each curve, and a seed only
    as long as it goes.

    Example:
        >>> one = RunCurve("x", [0, 10, 20], [0, 1, 2], "steps")
        >>> two = RunCurve("x", [10, 30], [1, 3], "steps")
        >>> over_seeds([one, two])[1].tolist()
        [[0.0, 1.0, 2.0, 2.0], [nan, 1.0, 2.0, 3.0]]
        >>> over_seeds([one, RunCurve("x", [5, 15], [7, 8], "steps")], from_start=True)[1].tolist()
        [[0.0, 1.0, 2.0], [7.0, 8.0, nan]]
    """
    own = [np.asarray(curve.steps, float) for curve in curves]
    if from_start:
        own = [steps - steps[0] for steps in own]
    steps = np.unique(np.concatenate(own))
    rows = zip(own, curves, strict=True)
    after = np.nan if from_start else None
    values = [np.interp(steps, x, c.values, left=np.nan, right=after) for x, c in rows]
    return steps, np.stack(values)


def draw_game(rows: Sequence[Row], path: Path, game: str) -> str:
    """Draw the running scores in a game against emulated steps: mean, least and largest over seeds.

    Nothing learns in them but a manager's guide, where there is one: the curve of a worker that
    learns is ``learning.png`` of its run.

    Returns the caption; it is empty, and nothing is drawn, without a run that has curves.

    Reference:
        Dissertation, figures 5.1 to 5.7.
    """
    groups: dict[str, list[Row]] = {}
    for protocol, members in by_protocol([r for r in rows if r.get("curves")], game).items():
        sources = sorted({str(row.get("source", "")) for row in members})
        for source in sources:
            name = protocol if len(sources) == 1 else f"{protocol}, options: {source}"
            groups[name] = [row for row in members if str(row.get("source", "")) == source]
    if not groups:
        return ""
    running = any(RUNNING in row["curves"] for members in groups.values() for row in members)
    shown = Figure(figsize=(10.0, 4.6), layout="constrained")
    left, right = shown.subplots(1, 2)
    for axes, entry in ((left, RUNNING if running else "score"), (right, "score_max")):
        for (protocol, members), color in zip(groups.items(), itertools.cycle(COLORS)):
            curves = [row["curves"][entry] for row in members if entry in row["curves"]]
            if curves:
                _draw_protocol(axes, entry, protocol, curves, color)
        axes.set_xlim(left=0)
    all_steps = "emulated steps, those in which options were looked for included"
    style(left, f"score of {'the episode being played' if running else 'an episode'}", short=True)
    left.set_xlabel("emulated steps since the options were found" if running else all_steps)
    algorithm, baseline = best_baseline(game)
    left.axhline(baseline, color="#71717a", linestyle=":", label=f"{algorithm} (Table A.1)")
    style(right, "highest score so far", short=True)
    right.set_xlabel(all_steps)
    highest = TABLE_5_1[game].score
    right.axhline(highest, color="#111827", linestyle="--", label="the dissertation's highest")
    legend_of_all(shown, ncols=3)
    shown.suptitle(game, fontsize=11, x=0.01, ha="left")
    save_figure(shown, path)
    return (
        f"{game}: running score of the episodes (left) and the highest so far (right), mean, least "
        "and largest over the seeds, against emulated steps. No worker learns meanwhile."
    )


def _draw_protocol(
    axes: Axes, entry: str, protocol: str, curves: Sequence[RunCurve], color: str
) -> None:
    steps, values = over_seeds(curves, from_start=entry == RUNNING)
    step: Any = "post" if entry == "score_max" else None
    if len(curves) > 1:
        low, high = np.nanmin(values, 0), np.nanmax(values, 0)
        axes.fill_between(steps, low, high, step=step, color=color, alpha=0.16, linewidth=0)
    axes.plot(
        steps,
        np.nanmean(values, 0),
        "--" if protocol.startswith("sticky") else "-",
        color=color,
        linewidth=2.0,
        marker="o" if len(steps) <= _FEW else "",  # a single episode is no line
        label=f"{protocol}, {len(curves)} seed{'s' if len(curves) > 1 else ''}",
        drawstyle=f"steps-{step}" if step else "default",
    )


def write_table(rows: Sequence[Row], path: Path) -> str:
    """Write Table 5.1 with our scores beside it, as a page and as Markdown beside that.

    Reference:
        Dissertation, tables 5.1 and A.1.
    """
    protocols = sorted({str(row.get("protocol", "deterministic")) for row in rows})
    ours = {
        (game, protocol): best_source(by_protocol(rows, game).get(protocol, []))
        for protocol in protocols
        for game in TABLE_5_1
    }
    head = ["game", "dissertation: highest", "its skills, steps", "best of Table A.1"]
    for protocol in protocols:
        head += [f"ours, {protocol}: mean", "least to largest", "who acts", "seeds", "frames"]
    cells = []
    for game, source in TABLE_5_1.items():
        algorithm, baseline = best_baseline(game)
        skills = f"{source.num_skills}, {source.option_steps}"
        line: list[Any] = [game, source.score, skills, Cell(baseline, beside=algorithm)]
        for protocol in protocols:
            runs = ours[game, protocol]
            means = [float(r["score_mean"]) for r in runs if "score_mean" in r]
            line.append(_interval(means))
            line.append(_range(runs))
            line.append(", ".join(sorted({str(r.get("acts", "rules")) for r in runs})) or "-")
            frames = [row["frames"] for row in runs if "frames" in row]
            line += [len(runs), round(sum(frames) / len(frames)) if frames else "-"]
        cells.append(line)
    normalised = [
        [protocol, key.replace("score_", ""), *_aggregated(ours, protocol, key)]
        for protocol in protocols
        for key in ("score_mean", "score_max")
    ]
    baselines = [[name, *(row[game] for game in TABLE_5_1)] for name, row in TABLE_A_1.items()]
    table = Table(cells, head)
    words = ["protocol", "score", "interquartile mean", "95 % interval", "games"]
    sections = [
        Section(words=[_NOTE], tables=[table]),
        Section("Human-normalised scores of all games", tables=[Table(normalised, words)]),
        Section(
            "Table A.1: means of OpenAI Baselines, as the dissertation gives them",
            tables=[Table(baselines, ["", *TABLE_5_1])],
        ),
    ]
    write_sections(path, "Table 5.1", sections)
    text = path.with_suffix(".md")
    lines = [[f"{plain(cell.value)} {cell.beside}".strip() for cell in row] for row in table.rows]
    rule = ["---"] * len(head)
    write_text(text, "".join(f"| {' | '.join(line)} |\n" for line in [head, rule, *lines]))
    return f"Table 5.1 with {len(rows)} run(s) of ours; as Markdown: {text.name}."


_NOTE = (
    "The dissertation gives the highest score of training, with the best of a grid of skills and "
    "steps, and a learned network acts. Ours are of the source of options with the highest mean "
    "in a game: the mean over the episodes of a run, and over its seeds with a 95 % bootstrap "
    "interval; beside it the least and the largest score of any episode, and whether rules or a "
    "network act."
)


def _aggregated(ours: Mapping[tuple[str, str], list[Row]], protocol: str, key: str) -> list[Any]:
    """The interquartile mean over all games with its interval, if every game has two seeds."""
    groups = [runs for (_, name), runs in ours.items() if name == protocol]
    scores = [[human_normalised(row, key) for row in runs if key in row] for runs in groups]
    scores = [seeds for seeds in scores if seeds]
    if not scores:
        return ["-", "-", 0]
    middle, low, high = aggregate(scores)
    several = min(map(len, scores)) > 1  # one run of a game says nothing about others of it
    interval = f"{low:.2f} to {high:.2f}" if several else "a game has one seed"
    return [f"{middle:.2f}", interval, len(scores)]


def _range(runs: Sequence[Row]) -> str:
    """The least and the largest score of all episodes of the runs."""
    scores = [float(e["score"]) for r in runs for e in r.get("episodes", [])]
    scores += [float(r["score_max"]) for r in runs if "score_max" in r]
    return f"{plain(min(scores))} to {plain(max(scores))}" if scores else "-"


def _interval(values: list[float]) -> Cell:
    if not values:
        return Cell("-")
    mean, low, high = bootstrap(values)
    return Cell(mean, beside=f"{plain(low)} to {plain(high)}" if len(values) > 1 else "")
