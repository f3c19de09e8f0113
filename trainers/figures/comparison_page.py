"""The page that sets several runs side by side, seeds of the same config as one group."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.experiments.registry import ALL_EXPERIMENTS
from torchrl_hmcts.trainers.figures.curve_panels import GROUP_COLORS, panel
from torchrl_hmcts.trainers.figures.foreign_files import refuse_foreign
from torchrl_hmcts.trainers.figures.intervals import bootstrap, interquartile_mean
from torchrl_hmcts.trainers.figures.page_parts import (
    Html,
    Number,
    details,
    drawing,
    grid,
    page,
    picture,
    plain,
    section,
    table,
    text,
)
from torchrl_hmcts.trainers.figures.report import say_damage
from torchrl_hmcts.trainers.figures.run_page import config_table, damage_of, flatten
from torchrl_hmcts.trainers.runs.folder import RunFolder, is_run, read_run
from torchrl_hmcts.trainers.saving.files import left_out, write_text

_NOT_COMPARED = ("seed", "out", "resume", "logger")  # keys in which runs of a group may differ
_SEEDS_FOR_IQM = 4
_KEYS_IN_NAME = 3  # of a group; all that differ are in the table of configs


@dataclass
class RunGroup:
    """Runs of one experiment and config that differ in their seeds only.

    Args:
        name: what sets it apart from the other groups.
        runs: one per seed.
    """

    name: str
    runs: list[RunFolder] = field(default_factory=list)

    def figures(self) -> dict[str, list[float]]:
        """Return the numbers of the finished runs, by name."""
        values: dict[str, list[float]] = {}
        for run in self.runs:
            for name, value in flatten(run.metrics):
                number = isinstance(value, int | float) and not isinstance(value, bool)
                if not number or name == "seed" or not math.isfinite(value):
                    continue
                if name.endswith((".median", ".p95")):  # the mean says enough beside other runs
                    continue
                values.setdefault(name.removesuffix(".mean"), []).append(float(value))
        return values


def group_runs(runs: Sequence[RunFolder]) -> list[RunGroup]:
    """Put runs that differ in their seeds only into groups, named by what sets them apart.

    Args:
        runs: in the order of the page.

    Example:
        >>> configs = [{"seed": seed, "size": size} for size in (9, 15) for seed in (0, 1)]
        >>> runs = [RunFolder(Path("x"), {"experiment": "x", "config": c}) for c in configs]
        >>> [(group.name, len(group.runs)) for group in group_runs(runs)]
        [('x, size=9', 2), ('x, size=15', 2)]
    """
    groups: dict[str, list[RunFolder]] = {}
    for run in runs:
        key = json.dumps([run.experiment, _compared(run)], sort_keys=True, default=str)
        groups.setdefault(key, []).append(run)
    firsts = [members[0] for members in groups.values()]
    named = []
    for members in groups.values():
        run = members[0]
        same = [other for other in firsts if other.experiment == run.experiment]
        differing = [
            f"{key}={value}"
            for key, value in _compared(run).items()
            if any(_compared(other).get(key) != value for other in same)
        ]
        words = [run.experiment or run.name, *differing[:_KEYS_IN_NAME]]
        if len(differing) > _KEYS_IN_NAME:
            words.append("...")
        named.append(RunGroup(", ".join(words), list(members)))
    return named


def write_comparison(folders: Sequence[str | Path], out: str | Path) -> Path:
    """Write the page that compares runs; it holds all its pictures.

    Args:
        folders: of the runs; one that is given twice counts once.
        out: file to write, or a folder for ``index.html``.

    Returns:
        The file.

    Raises:
        ValueError: if one is no folder of a run, or ``out`` is a run's folder or a file that this
            package did not write.
    """
    paths = list({path.resolve(): path for path in map(Path, folders)}.values())
    file = Path(out)
    if file.suffix.lower() not in (".html", ".htm"):
        file = file / "index.html"
        if is_run(file.parent):
            raise ValueError(f"out={out} is the folder of a run, whose page is index.html.")
    refuse_foreign(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    runs = [read_run(path) for path in paths]
    say_damage(*runs)
    write_text(file, comparison_page(group_runs(runs)))
    return file


def comparison_page(groups: Sequence[RunGroup]) -> str:
    """Return the page of several groups of runs.

    Args:
        groups: of :func:`group_runs`.

    Returns:
        HTML with everything in it.
    """
    runs = [run for group in groups for run in group.runs]
    names: list[str] = []
    for run in runs:
        names += [n for n, c in run.curves.items() if n not in names and len(c.steps) > 1]
    panels = []
    with left_out("the curves of the page"):
        for name in names:
            curves = {g.name: [r.curves[name] for r in g.runs if name in r.curves] for g in groups}
            panels.append(drawing(panel(name, curves), name))
    several = any(len(group.runs) > 1 for group in groups)
    lines = "Lines are means over the seeds, bands go from the least to the largest of them."
    return page(
        f"{len(runs)} runs compared",
        Html("".join(f"<div>{_key(i)}{text(_count(g))}</div>" for i, g in enumerate(groups))),
        section(
            "Figures",
            Html('<p class="lead">Means over seeds; below, 95 % bootstrap intervals.</p>')
            if several
            else "",
            _figures(groups),
        ),
        section(
            "Curves",
            Html(f'<p class="lead">{lines}</p>') if several and panels else "",
            grid(panels, "panels"),
        ),
        section("Pictures", *_pictures(groups)),
        section("Config", *_configs(groups)),
        section("Runs", *map(damage_of, runs), _runs(runs)),
    )


def _compared(run: RunFolder) -> dict[str, Any]:
    """The keys that make a group; those that an older run did not have yet, by their defaults."""
    defaults: dict[str, Any] = {}
    if run.experiment in ALL_EXPERIMENTS:
        config_class = ALL_EXPERIMENTS[run.experiment].config_class
        defaults = {key.name: key.default for key in fields(config_class)}
    values = {**defaults, **run.config}
    return {key: value for key, value in values.items() if key not in _NOT_COMPARED}


def _count(group: RunGroup) -> str:
    seeds = ", ".join(str(run.seed) for run in group.runs if run.seed is not None)
    unfinished = sum(not run.finished for run in group.runs)
    words = f"{group.name}: seed{'s' if len(group.runs) > 1 else ''} {seeds}"
    return words + (f" ({unfinished} not finished)" if unfinished else "")


def _key(index: int) -> Html:
    color = GROUP_COLORS[index % len(GROUP_COLORS)]
    return Html(f'<span class="key" style="background:{color}"></span>')


def _figures(groups: Sequence[RunGroup]) -> Html:
    """A row per figure, a column per group."""
    columns = [group.figures() for group in groups]
    names: list[str] = []
    for figures in columns:
        names += [name for name in figures if name not in names]
    if not names:
        return Html("<p>No run has finished.</p>")
    rows = [[_name(name), *(_cell(figures.get(name)) for figures in columns)] for name in names]
    head = [
        "",
        *(Html(f"{_key(i)}{text(group.name)}") for i, group in enumerate(groups)),
    ]
    return table(rows, head)


def _name(figure: str) -> Html:
    return Html(
        f'<span class="name" title="{text(figure)}">{text(figure.replace("_", " "))}</span>'
    )


def _cell(values: list[float] | None) -> Html:
    if not values:
        return Number("-")
    mean = bootstrap(values)
    shown = text(plain(_whole(mean.middle)))
    if mean.low < mean.high:
        shown += f"<br><small>{text(_whole(mean.low))} to {text(_whole(mean.high))}</small>"
    if mean.count >= _SEEDS_FOR_IQM and mean.low < mean.high:
        middle = bootstrap(values, interquartile_mean).middle
        shown += f"<br><small>middle half {text(_whole(middle))}</small>"
    return Number(shown)


def _whole(value: float) -> float | int:
    return int(value) if value.is_integer() else value


def _pictures(groups: Sequence[RunGroup]) -> list[Html]:
    """Each picture of each group's first run that has it, side by side."""
    names: dict[str, str] = {}
    for group in groups:
        for run in group.runs:
            for file, caption in run.pictures.items():
                names.setdefault(file, caption)
    parts = []
    for file, caption in names.items():
        shown = []
        for group in groups:
            first = next((run for run in group.runs if file in run.pictures), None)
            if first is not None:
                words = f"{group.name}, seed {first.seed}"
                shown.append(picture(first.path / file, words, embed=True))
        parts.append(Html(f"<h3>{text(caption or file)}</h3>{grid(shown, 'pictures')}"))
    return parts


def _configs(groups: Sequence[RunGroup]) -> list[Html]:
    """What differs, and below, folded away, each group's whole config."""
    parts = []
    keys = {key for group in groups for key in _compared(group.runs[0])}
    if len({group.runs[0].experiment for group in groups}) == 1 and len(groups) > 1:
        rows = []
        for key in sorted(keys):
            values = [_compared(group.runs[0]).get(key) for group in groups]
            if any(value != values[0] for value in values):
                rows.append([Html(f"<code>{text(key)}</code>"), *map(str, values)])
        parts.append(table(rows, ["differs", *(group.name for group in groups)]))
    for group in groups:
        run = group.runs[0]
        config = {k: v for k, v in run.config.items() if k not in ("seed", "out", "resume")}
        parts.append(details(f"All keys of {group.name}", config_table(run.experiment, config)))
    return parts


def _runs(runs: Sequence[RunFolder]) -> Html:
    rows = []
    for run in runs:
        machine = run.record.get("machine") or {}
        versions = run.record.get("versions") or {}
        rows.append(
            [
                run.name,
                str(run.seed),
                run.status or ("finished" if run.finished else "unknown"),
                Html(f"<code>{text(' ; '.join(run.record.get('commands', [])) or '-')}</code>"),
                ", ".join(f"{name} {version}" for name, version in versions.items()),
                f"{machine['cpus']} CPUs, {machine['platform']}" if machine else "-",
            ]
        )
    return table(rows, ["folder", "seed", "status", "command", "versions", "machine"])
