"""Chapter 5: scores in seven games, ours beside the source's and the baselines' of its Table A.1.

Runs of the experiment ``atari`` have in ``metrics.json`` the entries ``game``, ``protocol``
(``"deterministic"`` or ``"sticky"``), ``seed``, ``score_max``, ``score_final`` and ``frames``, and
in ``curves.csv`` the curves ``score`` and ``score_max`` against emulated steps. Files in
``docs/results/atari`` are lists of such summaries, with an entry ``curves`` for the figures:
``{"score": {"step": [...], "value": [...]}, "score_max": {...}}``, and RUNNING, the score of the
episode being played at every 1,000th base step.
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
from matplotlib.ticker import EngFormatter, MaxNLocator

from torchrl_hmcts.trainers.figures.curve_panels import GROUP_COLORS
from torchrl_hmcts.trainers.figures.dissertation import Sources, find_figure
from torchrl_hmcts.trainers.figures.intervals import bootstrap, interquartile_mean
from torchrl_hmcts.trainers.figures.page_parts import Html, Number, page, plain, table, text
from torchrl_hmcts.trainers.figures.pictures import save_figure
from torchrl_hmcts.trainers.runs.folder import RunCurve
from torchrl_hmcts.trainers.saving.files import write_text

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
    """Return the best algorithm of Table A.1 in a game, and its mean score.

    Args:
        game: e.g. ``"Breakout"``.

    Example:
        >>> best_baseline("Breakout")
        ('deepq', 131.46)
    """
    return max(((name, row[game]) for name, row in TABLE_A_1.items()), key=lambda pair: pair[1])


def summaries(sources: Sources) -> list[dict[str, Any]]:
    """Return the summaries of the runs given, else those of ``docs/results/atari``.

    Args:
        sources: of the figures.
    """
    runs = []
    for run in sources.of("atari"):
        if "game" in {**run.config, **run.metrics}:
            runs.append({**run.config, **run.metrics, "curves": run.curves})
    folder = sources.result("atari")
    if runs or folder is None:
        return runs
    for file in sorted(folder.glob("*.json")):
        rows = json.loads(file.read_text(encoding="utf-8"))
        for row in rows if isinstance(rows, list) else []:
            curves = {
                name: RunCurve(name, curve["step"], curve["value"], "steps")
                for name, curve in row.get("curves", {}).items()
            }
            runs.append({**row, "curves": curves})
    return runs


def by_protocol(rows: Sequence[Mapping[str, Any]], game: str) -> dict[str, list[Mapping[str, Any]]]:
    """Return the summaries of a game, by protocol."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if row.get("game") == game:
            groups.setdefault(str(row.get("protocol", "deterministic")), []).append(row)
    return groups


def _by_source(
    groups: Mapping[str, list[Mapping[str, Any]]],
) -> dict[str, list[Mapping[str, Any]]]:
    """Split the runs of a protocol by where their options come from, if from several sources."""
    split: dict[str, list[Mapping[str, Any]]] = {}
    for protocol, rows in groups.items():
        found = sorted({str(row.get("source", "")) for row in rows})
        for source in found:
            name = protocol if len(found) == 1 else f"{protocol}, options: {source}"
            split[name] = [row for row in rows if str(row.get("source", "")) == source]
    return split


def human_normalised(row: Mapping[str, Any], key: str) -> float:
    """Return a run's score in units of what a human scores more than random play.

    Args:
        row: summary of a run.
        key: ``"score_max"`` or ``"score_final"``.

    Reference:
        Mnih et al., "Human-level control through deep reinforcement learning", 2015.

    Example:
        >>> human_normalised({"game": "Pong", "score_max": 14.6}, "score_max")
        1.0
    """
    human, random = HUMAN_AND_RANDOM[row["game"]]
    return float((row[key] - random) / (human - random))


def aggregate(scores: Sequence[Sequence[float]], draws: int = 5_000) -> tuple[float, float, float]:
    """Return the interquartile mean over games and seeds with its stratified 95 % interval.

    Each game counts as much as another, however many seeds it has.

    Args:
        scores: human-normalised, of the seeds of each game.
        draws: resamples of the seeds within each game, from a fixed seed.

    Reference:
        Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
        2021, arXiv 2108.13264.

    Example:
        >>> aggregate([[1.0], [2.0], [3.0], [10.0]])
        (2.5, 2.5, 2.5)
        >>> aggregate([[1.0, 1.0, 1.0], [2.0], [3.0], [10.0]])
        (2.5, 2.5, 2.5)
    """
    generator = np.random.default_rng(0)
    often = math.lcm(*map(len, scores))

    def mean(samples: Sequence[np.ndarray]) -> Any:
        equal = [game.repeat(often // game.shape[-1], -1) for game in samples]
        return interquartile_mean(np.concatenate(equal, -1))

    means = mean([generator.choice(np.array(g), size=(draws, len(g))) for g in scores])
    middle = float(mean([np.array(g) for g in scores]))
    low, high = np.percentile(means, [2.5, 97.5])
    return middle, float(low), float(high)


def best_source(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the runs of the source of options that scored highest among the runs of a game.

    Args:
        rows: summaries of one game and protocol.

    Example:
        >>> rows = [{"source": "goals", "score_max": 3.0}, {"source": "repeat", "score_max": 7.0}]
        >>> best_source([*rows, {"source": "repeat", "score_max": 1.0}]) == [rows[1], {
        ...     "source": "repeat", "score_max": 1.0}]
        True
    """
    if not rows:
        return []
    winner = max(rows, key=lambda row: float(row.get("score_max", float("-inf"))))
    return [row for row in rows if row.get("source") == winner.get("source")]


def over_seeds(
    curves: Sequence[RunCurve], *, from_start: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Bring curves that begin and end at different steps together.

    A seed counts from its first value on, since looking for options takes some longer than others,
    and keeps its last value to the end.

    Args:
        curves: one per seed, S of them.
        from_start: count steps from the first of each curve, and a seed only as long as it goes.

    Returns:
        Steps ``[G]`` and values ``[S, G]``, NaN where a seed does not count.

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


def draw_game(sources: Sources, path: Path, name: str) -> str:
    """Draw the scores in a game against emulated steps: mean, least and largest over the seeds.

    Args:
        sources: of the figures.
        path: PNG to write.
        name: of the figure, which says the game.

    Returns:
        The caption.

    Raises:
        MissingData: if there is no run with curves.

    Reference:
        Dissertation, figures 5.1 to 5.7.
    """
    figure = find_figure(name)
    game = figure.argument
    groups = {
        protocol: [row for row in rows if row.get("curves")]
        for protocol, rows in by_protocol(summaries(sources), game).items()
    }
    groups = _by_source({protocol: rows for protocol, rows in groups.items() if rows})
    if not groups:
        raise figure.how_to_get_data(f"there is no run of {game} with its curves.")
    shown = Figure(figsize=(10.0, 4.6), layout="constrained")
    panels = shown.subplots(1, 2)
    colors = dict(zip(groups, itertools.cycle(GROUP_COLORS), strict=False))
    running = any(RUNNING in row["curves"] for rows in groups.values() for row in rows)
    all_steps = "emulated steps, those in which options were looked for included"
    titles = {
        RUNNING if running else "score": "score of the episode being played"
        if running
        else "score of an episode",
        "score_max": "highest score so far",
    }
    for axes, (entry, title) in zip(panels, titles.items(), strict=True):
        for protocol, color in colors.items():
            curves = [row["curves"][entry] for row in groups[protocol] if entry in row["curves"]]
            if curves:
                _draw_protocol(axes, entry, protocol, curves, color)
        axes.set_title(title, fontsize=10, loc="left")
        axes.grid(alpha=0.25)
        axes.set_xlim(left=0)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.spines[["top", "right"]].set_visible(False)
    source, (algorithm, baseline) = TABLE_5_1[game], best_baseline(game)
    panels[1].axhline(
        source.score, color="#111827", linestyle="--", linewidth=1.4, label="the source's highest"
    )
    panels[0].axhline(
        baseline, color="#71717a", linestyle=":", linewidth=1.4, label=f"{algorithm} (Table A.1)"
    )
    handles = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    shown.legend(
        handles.values(), handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9
    )
    panels[0].set_xlabel("emulated steps since the options were found" if running else all_steps)
    panels[1].set_xlabel(all_steps)
    shown.suptitle(game, fontsize=11, x=0.01, ha="left")
    save_figure(shown, path)
    return (
        f"{game}: mean, least and largest over the seeds that play (left) or have a score (right), "
        "against emulated steps."
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


def write_table(sources: Sources, path: Path, name: str) -> str:
    """Write Table 5.1 with our scores beside the source's, as a page and as Markdown beside it.

    Args:
        sources: of the figures.
        path: HTML to write.
        name: of the table.

    Returns:
        What to say about it.

    Raises:
        MissingData: if there is no run.

    Reference:
        Dissertation, tables 5.1 and A.1.
    """
    rows = summaries(sources)
    if not rows:
        raise find_figure(name).how_to_get_data("there is no run of atari.")
    protocols = sorted({str(row.get("protocol", "deterministic")) for row in rows})
    head = ["game", "source: highest", "source: skills, steps", "best of Table A.1"]
    for protocol in protocols:
        head += [f"ours, {protocol}: highest", f"ours, {protocol}: at the end", "seeds"]
    cells = []
    for game, source in TABLE_5_1.items():
        algorithm, baseline = best_baseline(game)
        line: list[Any] = [
            game,
            source.score,
            f"{source.num_skills}, {source.option_steps}",
            Number(f"{text(baseline)} <small>{text(algorithm)}</small>"),
        ]
        groups = by_protocol(rows, game)
        for protocol in protocols:
            group = best_source(groups.get(protocol, []))
            highest = [float(row["score_max"]) for row in group if "score_max" in row]
            line.append(max(highest) if highest else "-")
            line.append(_interval([float(r["score_final"]) for r in group if "score_final" in r]))
            line.append(len(group))
        cells.append(line)
    ours = {
        protocol: [best_source(by_protocol(rows, game).get(protocol, [])) for game in TABLE_5_1]
        for protocol in protocols
    }
    how = [
        [game, protocol, *_how(group)]
        for protocol in protocols
        for game, group in zip(TABLE_5_1, ours[protocol], strict=True)
        if group
    ]
    means = [
        [protocol, text(key.replace("score_", "")), *_aggregated(ours[protocol], key)]
        for protocol in protocols
        for key in ("score_max", "score_final")
    ]
    baselines = [
        [algorithm, *(row[game] for game in TABLE_5_1)] for algorithm, row in TABLE_A_1.items()
    ]
    note = (
        "The source gives the highest score of training, with the best of a grid of skills and "
        "steps. Ours are of the source of options that scored highest in a game; scores at the end "
        "are means over its seeds with 95 % bootstrap intervals."
    )
    write_text(
        path,
        page(
            "Table 5.1",
            Html(f'<p class="lead">{text(note)}</p>'),
            table(cells, head),
            Html("<h2>What they took</h2>"),
            table(how, _HOW),
            Html("<h2>Human-normalised scores of all games</h2>"),
            table(means, ["protocol", "score", "interquartile mean", "95 % interval", "games"]),
            Html("<h2>Table A.1: means of OpenAI Baselines, as the source gives them</h2>"),
            table(baselines, ["", *TABLE_5_1]),
        ),
    )
    markdown = [" | ".join(head), " | ".join("---" for _ in head)]
    markdown += [" | ".join(_as_plain(cell) for cell in line) for line in cells]
    text_file = path.with_suffix(".md")
    write_text(text_file, "\n".join(f"| {line} |" for line in markdown) + "\n")
    return f"Table 5.1 with {len(rows)} run(s) of ours; as Markdown: {text_file.name}."


_HOW = (
    "game", "protocol", "options from", "options, steps", "frames, all kinds",
    "frames per decision", "seconds",
)  # fmt: skip


def _how(group: Sequence[Mapping[str, Any]]) -> list[Any]:
    """What the runs of a game took: means over the seeds."""
    first = group[0]

    def mean(key: str) -> Any:
        values = [float(row[key]) for row in group if row.get(key) is not None]
        return round(sum(values) / len(values)) if values else "-"

    per_decision = mean("frames_per_decision")
    if per_decision == "-" and first.get("episodes"):  # a run of before it was written
        decisions = sum(int(e["decisions"]) for row in group for e in row["episodes"])
        spent = ("frames_finding_options", "frames_tuning")
        frames = sum(row["frames"] - sum(row.get(key, 0) for key in spent) for row in group)
        per_decision = round(frames / max(1, decisions))
    found = f"{len(first.get('options', []))}, {first.get('option_steps', '-')}"
    return [first.get("source", "-"), found, mean("frames"), per_decision, mean("seconds")]


def _aggregated(groups: Sequence[Sequence[Mapping[str, Any]]], key: str) -> list[Any]:
    """The interquartile mean over all games with its interval, if every game has two seeds."""
    scores = [[human_normalised(row, key) for row in group if key in row] for group in groups]
    scores = [seeds for seeds in scores if seeds]
    if not scores:
        return ["-", "-", 0]
    middle, low, high = aggregate(scores)
    several = min(map(len, scores)) > 1  # one run of a game says nothing about others of it
    return [
        f"{middle:.2f}",
        f"{low:.2f} to {high:.2f}" if several else "a game has one seed",
        len(scores),
    ]


def _interval(values: list[float]) -> Html | str:
    if not values:
        return "-"
    mean = bootstrap(values)
    shown = text(plain(mean.middle))
    if mean.count > 1:
        shown += f" <small>{text(mean.low)} to {text(mean.high)}</small>"
    return Number(shown)


def _as_plain(cell: Any) -> str:
    words = plain(cell)
    for tag in ("<small>", "</small>"):
        words = words.replace(tag, "")
    return words
