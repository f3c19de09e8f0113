"""The page that sets several runs side by side, seeds of the same config as one group."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.figures.intervals import bootstrap, interquartile_mean
from torchrl_hmcts.trainers.figures.pages import (
    Cell,
    Picture,
    Section,
    Table,
    drawing,
    picture,
    plain,
    write_sections,
)
from torchrl_hmcts.trainers.figures.pictures import COLORS, refuse_foreign
from torchrl_hmcts.trainers.figures.run_page import (
    config_tables,
    curve_sections,
    damage_of,
    facts_of,
    say_damage,
    telling,
)
from torchrl_hmcts.trainers.saving.files import left_out
from torchrl_hmcts.trainers.saving.run_folder import RunFolder, flat, is_run

_NOT_COMPARED = ("seed", "out", "resume", "logger")  # keys in which runs of a group may differ
_SEEDS_FOR_IQM = 4
_KEYS_IN_NAME = 3  # of a group; all that differ are in the table of configs


@dataclass
class RunGroup:
    """Runs of one experiment and config that differ in their seeds only."""

    name: str
    runs: list[RunFolder] = field(default_factory=list)

    def figures(self) -> dict[str, list[float]]:
        """Return the numbers of the finished runs, by name."""
        values: dict[str, list[float]] = {}
        for run in self.runs:
            for name, value in flat(run.metrics):
                number = isinstance(value, int | float) and not isinstance(value, bool)
                if not number or name == "seed" or not math.isfinite(value):
                    continue
                if name.endswith((".median", ".p95")):  # the mean says enough beside other runs
                    continue
                values.setdefault(name.removesuffix(".mean"), []).append(float(value))
        return values


def group_runs(runs: Sequence[RunFolder]) -> list[RunGroup]:
    """Put runs that differ in their seeds only into groups, named by what sets them apart."""
    groups: dict[str, list[RunFolder]] = {}
    for run in runs:
        key = json.dumps([run.experiment, _compared(run)], sort_keys=True, default=str)
        groups.setdefault(key, []).append(run)
    firsts = [members[0] for members in groups.values()]
    named = []
    for run, members in zip(firsts, groups.values(), strict=True):
        same = [other for other in firsts if other.experiment == run.experiment]
        differing = [
            f"{key}={value}"
            for key, value in _compared(run).items()
            if any(_compared(other).get(key) != value for other in same)
        ]
        words = [run.experiment or run.name, *differing[:_KEYS_IN_NAME]]
        words += ["..."] * (len(differing) > _KEYS_IN_NAME)
        named.append(RunGroup(", ".join(words), members))
    return named


def write_comparison(runs: Sequence[RunFolder], out: str | Path) -> Path:
    """Write the page that compares runs; it holds all its pictures."""
    runs = list({run.path.resolve(): run for run in runs}.values())
    file = Path(out)
    if file.suffix.lower() not in (".html", ".htm"):
        file = file / "index.html"
        if is_run(file.parent):
            raise ValueError(f"out={out} is the folder of a run, whose page is index.html.")
    refuse_foreign(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    say_damage(*runs)
    write_sections(file, f"{len(runs)} runs compared", _sections(group_runs(runs)))
    return file


def _sections(groups: Sequence[RunGroup]) -> list[Section]:
    several = any(len(group.runs) > 1 for group in groups)
    lines = "Lines are means over the seeds, bands go from the least to the largest of them."
    means = "Means over seeds; below, 95 % bootstrap intervals."
    runs = [run for group in groups for run in group.runs]
    figures, alone = _figures(groups)
    return [
        Section(
            tables=[
                Table([[Cell(_count(group), color=_color(i))] for i, group in enumerate(groups)])
            ]
        ),
        Section(
            "Figures",
            words=[means] * several if figures or alone else [],
            tables=figures or ([] if alone else [Table([["No run has finished."]])]),
            inside=[Section("Figures that one group alone has", tables=alone, folded=True)],
        ),
        *curve_sections(_panels(groups), [lines] * several),
        Section("Pictures", inside=_pictures(groups)),
        Section("Config", tables=_differing(groups), inside=[_config(group) for group in groups]),
        Section(
            "Runs", words=[words for run in runs for words in damage_of(run)], tables=[_runs(runs)]
        ),
    ]


def _compared(run: RunFolder) -> dict[str, Any]:
    """The keys that make a group; those that an older run did not have yet, by their defaults."""
    values = {**{key: default for key, (default, _) in run.keys.items()}, **run.config}
    return {key: value for key, value in values.items() if key not in _NOT_COMPARED}


def _color(index: int) -> str:
    return COLORS[index % len(COLORS)]


def _count(group: RunGroup) -> str:
    seeds = ", ".join(str(run.seed) for run in group.runs if run.seed is not None)
    unfinished = sum(not run.finished for run in group.runs)
    words = f"{group.name}: seed{'s' if len(group.runs) > 1 else ''} {seeds}"
    return words + (f" ({unfinished} not finished)" if unfinished else "")


def _figures(groups: Sequence[RunGroup]) -> tuple[list[Table], list[Table]]:
    """A row per figure, a column per group: what can be compared, and what one group alone has."""
    columns = [group.figures() for group in groups]
    names = dict.fromkeys(name for figures in columns for name in figures)
    shared: list[list[Any]] = []
    alone: list[list[Any]] = []
    for name in names:
        key = Cell(name.replace("_", " "), title=name, kind="name")
        having = sum(name in figures for figures in columns)
        rows = shared if having >= min(2, len(groups)) else alone
        rows.append([key, *(_statistics(figures.get(name)) for figures in columns)])
    head = ["", *(Cell(group.name, color=_color(i)) for i, group in enumerate(groups))]
    tables = [[Table(rows, head)] if rows else [] for rows in (shared, alone)]
    return tables[0], tables[1]


def _statistics(values: list[float] | None) -> Cell:
    if not values:
        return Cell("-", number=True)

    def shown(value: float) -> str:
        return plain(int(value) if value.is_integer() else value)

    mean, low, high = bootstrap(values)
    below = [f"{shown(low)} to {shown(high)}"] if low < high else []
    if below and len(values) >= _SEEDS_FOR_IQM:
        below.append(f"middle half {shown(bootstrap(values, interquartile_mean)[0])}")
    return Cell(shown(mean), below=below, number=True)


def _panels(groups: Sequence[RunGroup]) -> list[Picture]:
    """A panel for each logged value, with all groups."""
    panels = []
    with left_out("the curves of the page"):
        from torchrl_hmcts.trainers.figures.curves import panel  # loads matplotlib

        found = [c for group in groups for run in group.runs for c in run.curves.values()]
        for name, label in telling(found).items():
            curves = [
                [(c.steps, c.values) for run in group.runs if (c := run.curves.get(name))]
                for group in groups
            ]
            panels.append(drawing(panel(name, curves, label), name))
    return panels


def _pictures(groups: Sequence[RunGroup]) -> list[Section]:
    """Each picture of each group's first run that has it, side by side."""
    captions: dict[str, str] = {}
    for group in groups:
        for run in group.runs:
            captions = {**run.pictures, **captions}
    sections = []
    for file, caption in captions.items():
        firsts = [next((run for run in g.runs if file in run.pictures), None) for g in groups]
        shown = [
            picture(run.path / file, f"{group.name}, seed {run.seed}", embed=True)
            for group, run in zip(groups, firsts, strict=True)
            if run is not None
        ]
        sections.append(Section(caption or file, pictures=shown))
    return sections


def _differing(groups: Sequence[RunGroup]) -> list[Table]:
    """The keys in which groups of one experiment differ."""
    configs = [_compared(group.runs[0]) for group in groups]
    if len({group.runs[0].experiment for group in groups}) > 1 or len(groups) == 1:
        return []
    rows = []
    for key in sorted({key for config in configs for key in config}):
        values = [config.get(key) for config in configs]
        if any(value != values[0] for value in values):
            rows.append([Cell(key, code=True), *map(str, values)])
    return [Table(rows, ["differs", *(group.name for group in groups)])]


def _config(group: RunGroup) -> Section:
    """A group's whole config, folded away."""
    run = group.runs[0]
    config = {k: v for k, v in run.config.items() if k not in ("seed", "out", "resume")}
    shown = RunFolder(run.path, {"config": config}, keys=run.keys)
    return Section(f"All keys of {group.name}", tables=config_tables(shown), folded=True)


def _runs(runs: Sequence[RunFolder]) -> Table:
    rows = [
        [
            run.name,
            str(run.seed),
            run.status or ("finished" if run.finished else "unknown"),
            Cell(" ; ".join(run.record.get("commands", [])) or "-", code=True),
            *(fact or "-" for fact in facts_of(run).values()),
        ]
        for run in runs
    ]
    return Table(rows, ["folder", "seed", "status", "command", "versions", "machine"])
