"""The page of a run, and that which sets several side by side, seeds of a config as a group."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.figures.intervals import bootstrap, interquartile_mean
from torchrl_hmcts.trainers.figures.pages import (
    Cell,
    Section,
    Table,
    drawing,
    picture,
    plain,
    write_sections,
)
from torchrl_hmcts.trainers.figures.pictures import COLORS, refuse_foreign
from torchrl_hmcts.trainers.saving.files import left_out, write_json
from torchrl_hmcts.trainers.saving.run_folder import (
    RunFolder,
    flat,
    is_run,
    read_run,
    shown_path,
)

_NOT_COMPARED = ("seed", "out", "resume", "logger")  # keys in which runs of a group may differ
_SEEDS_FOR_IQM = 4
_KEYS_IN_NAME = 3  # of a group; all that differ are in the table of configs
_LEADING = 4  # curves that a page leads with; the others are folded
_DECIDING = (  # the first of these that a run has
    *("solved", "eval_solved_share", "score", "discriminator_accuracy", "frames"),
    *("eval_episode_steps", "state_coverage_total", "actor_loss", "loss_actor", "critic_loss"),
    *("qvalue_loss_0", "loss_discriminator", "discriminator_loss", "episode_return"),
)

Keys = Mapping[str, tuple[Any, str]]
"""Default and meaning of each key of an experiment."""


def write_page(
    path: Path,
    *,
    title: str,
    metrics: Mapping[str, Any],
    pictures: Mapping[str, str],
    keys: Keys | None = None,
) -> None:
    """Write a run's page, and beside it what it takes to write it again; everything is escaped."""
    write_json(path.parent / "page.json", {"title": title, "pictures": dict(pictures)})
    run = read_run(path.parent) if is_run(path.parent) else RunFolder(path.parent)
    for name in ("config", "versions"):
        run.record.setdefault(name, metrics.get(name, {}))
    run.metrics = {k: v for k, v in metrics.items() if k not in ("config", "versions")}
    run.title, run.pictures, run.keys = title, dict(pictures), keys or {}
    write_sections(path, title, run_sections(run))


def write_run_page(run: RunFolder, out: str | Path | None = None) -> Path:
    """Write the page of a run from what is in its folder, finished or not."""
    say_damage(run)
    file = run.path / "index.html" if out is None else Path(out)
    if out is not None and file.name == "index.html" and is_run(file.parent):
        if not file.parent.samefile(run.path):
            raise ValueError(f"{file} is the page of another run. Choose another place with out=.")
    refuse_foreign(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_sections(file, run.title or run.name, run_sections(run, embed=out is not None))
    return file


def say_damage(*runs: RunFolder) -> None:
    """Say on stderr which files of runs cannot be read; their pages say so too."""
    for run in runs:
        for sentence in run.damage:
            print(sentence, file=sys.stderr)


def curve_sections(groups: Sequence[Sequence[RunFolder]], words: str = "") -> list[Section]:
    """Return a panel for each logged value that says something, the deciding ones first."""
    panels = []
    with left_out("the curves of the page"):
        from torchrl_hmcts.trainers.figures.curves import panel, says_something  # load matplotlib

        found = [c for runs in groups for run in runs for c in run.curves.values()]
        labels = {c.name: c.step_label for c in found if says_something(c.steps, c.values)}
        rank = {name: i for i, name in enumerate(_DECIDING)}
        for name in sorted(labels, key=lambda name: rank.get(name, len(rank))):
            curves = [
                [(c.steps, c.values) for run in runs if (c := run.curves.get(name))]
                for runs in groups
            ]
            panels.append(drawing(panel(name, curves, labels[name]), name))
    return [
        Section("Curves", words=[words] if panels and words else [], panels=panels[:_LEADING]),
        Section("All other curves", panels=panels[_LEADING:], folded=True),
    ]


def run_sections(run: RunFolder, *, embed: bool = False) -> list[Section]:
    """Return what stands on the page of a run."""
    files = run.pictures.items()
    facts = {**facts_of(run), "status": run.status}
    resume = []
    if not run.finished and "out" in run.config:
        resume = [f"hmcts train {shlex.quote('resume=' + shown_path(str(run.config['out'])))}"]
    known = [(name, value) for name, value in facts.items() if value]
    return [
        Section(
            words=[_lead(run), *(f"Damaged: {words}" for words in run.damage)],
            pictures=[picture(run.path / file, words, embed=embed) for file, words in files],
        ),
        Section("Figures", columns=result_tables(run.metrics)),
        Section("Evaluated again", inside=[_evaluation(e) for e in run.evaluations]),
        *curve_sections([[run]]),
        Section("Config", tables=config_tables(run)),
        Section("Continue it with", code=resume),
        Section(
            "How it was made",
            code=run.record.get("commands", []),
            tables=[Table(known)] if known else [],
        ),
    ]


def facts_of(run: RunFolder) -> dict[str, str]:
    """Return the versions and the machine of a run; empty where they are unknown."""
    machine = run.record.get("machine") or {}
    versions = run.record.get("versions") or {}
    return {
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "machine": f"{machine['cpus']} CPUs, {machine['platform']}" if machine else "",
    }


def result_tables(metrics: Mapping[str, Any], prefix: str = "") -> list[Table]:
    """Return figures as tables, one for each group; a mean with its quantiles is one row."""
    rows: list[tuple[Any, Any]] = []
    inner: list[Table] = []
    heading = (prefix[:-1]).replace(".", ": ").replace("_", " ")
    for name, value in metrics.items():
        words = name.replace("_", " ")
        key = Cell(words, title=prefix + name)
        if is_spread(value):
            others = ", ".join(f"{k} {plain(v)}" for k, v in value.items() if k != "mean")
            rows.append((key, Cell(value["mean"], beside=others)))
        elif name == "unsolved" and isinstance(value, list):  # which mazes, not how many
            rows.append((key, len(value)))
            rows.append(("indices of the unsolved mazes", value))
        elif isinstance(value, Mapping):
            inner += result_tables(value, f"{prefix}{name}.")
        elif _are_records(value):
            head = [column.replace("_", " ") for column in value[0]]
            title = f"{heading}: {words}" if heading else words
            inner.append(Table([list(row.values()) for row in value], head, title))
        else:
            rows.append((key, value))
    return ([Table(rows, title=heading)] if rows else []) + inner


def _are_records(value: Any) -> bool:
    """Whether a figure is a list of rows with the same columns, e.g. one for each episode."""
    return (
        isinstance(value, Sequence)
        and len(value) > 0
        and all(isinstance(row, Mapping) and list(row) == list(value[0]) for row in value)
    )


def is_spread(value: Any) -> bool:
    """Return whether a figure is a mean with its quantiles."""
    return (
        isinstance(value, Mapping)
        and "mean" in value
        and set(value) <= {"mean", "median", "p95", "min", "max"}
        and not any(isinstance(x, Mapping) for x in value.values())
    )


def config_tables(run: RunFolder) -> list[Table]:
    """Return the keys of a run with values and meaning; what is not the default stands out."""
    rows = []
    for key, value in run.config.items():
        default, meaning = run.keys.get(key, (value, ""))
        shown = shown_path(value) if isinstance(value, str) else _exact(value)
        was = "" if value == default else f"default: {_exact(default)}"
        rows.append((Cell(key, code=True), Cell(shown, kind="changed", title=was), meaning))
    return [Table(rows, ("key", "value", "meaning"), kind="stack")] if rows else []


def _lead(run: RunFolder) -> str:
    words = [run.experiment] if run.experiment else []
    if run.seed is not None:
        words.append(f"seed {run.seed}")
    if not run.finished:
        words.append(f"not finished ({run.status})" if run.status else "not finished")
    if run.config.get("toy"):
        words.append("toy size: shows that everything works, not what can be reached")
    return ", ".join(words)


def _evaluation(evaluation: Mapping[str, Any]) -> Section:
    changes = ", ".join(f"{k}={_exact(v)}" for k, v in evaluation.get("changes", {}).items())
    return Section(
        changes or "with the config of the run",
        code=[evaluation.get("command", "")],
        columns=result_tables(evaluation.get("results", {})),
    )


def _exact(value: Any) -> str:
    """As it would be typed."""
    return str(value).lower() if isinstance(value, bool) else str(value)


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
        *curve_sections([group.runs for group in groups], lines * several),
        Section("Pictures", inside=_pictures(groups)),
        Section("Config", tables=_differing(groups), inside=[_config(group) for group in groups]),
        Section(
            "Runs",
            words=[f"Damaged: {words}" for run in runs for words in run.damage],
            tables=[_runs(runs)],
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
