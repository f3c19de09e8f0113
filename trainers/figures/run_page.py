"""The page of a run: its figures, pictures, curves and config in one HTML file."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

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
from torchrl_hmcts.trainers.figures.pictures import refuse_foreign
from torchrl_hmcts.trainers.saving.files import left_out, write_json
from torchrl_hmcts.trainers.saving.run_folder import (
    RunCurve,
    RunFolder,
    is_run,
    read_run,
    shown_path,
)

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


def telling(curves: Iterable[RunCurve]) -> dict[str, str]:
    """Return names of curves worth a panel, those that decide first, and labels of their steps."""
    from torchrl_hmcts.trainers.figures.curves import says_something

    labels = {c.name: c.step_label for c in curves if says_something(c.steps, c.values)}
    rank = {name: i for i, name in enumerate(_DECIDING)}
    return {name: labels[name] for name in sorted(labels, key=lambda n: rank.get(n, len(rank)))}


def curve_sections(panels: Sequence[Picture], words: Sequence[str] = ()) -> list[Section]:
    """Return the leading panels, and the others folded."""
    return [
        Section("Curves", words=list(words) if panels else [], panels=panels[:_LEADING]),
        Section("All other curves", panels=panels[_LEADING:], folded=True),
    ]


def run_sections(run: RunFolder, *, embed: bool = False) -> list[Section]:
    """Return what stands on the page of a run."""
    panels = []
    with left_out("the curves of the page"):
        from torchrl_hmcts.trainers.figures.curves import panel  # loads matplotlib

        for name, label in telling(run.curves.values()).items():
            curve = run.curves[name]
            panels.append(drawing(panel(name, [[(curve.steps, curve.values)]], label), name))
    files = run.pictures.items()
    facts = {**facts_of(run), "status": run.status}
    resume = []
    if not run.finished and "out" in run.config:
        resume = [f"hmcts train {shlex.quote('resume=' + shown_path(str(run.config['out'])))}"]
    known = [(name, value) for name, value in facts.items() if value]
    return [
        Section(
            words=[_lead(run), *damage_of(run)],
            pictures=[picture(run.path / file, words, embed=embed) for file, words in files],
        ),
        Section("Figures", columns=result_tables(run.metrics)),
        Section("Evaluated again", inside=[_evaluation(e) for e in run.evaluations]),
        *curve_sections(panels),
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


def damage_of(run: RunFolder) -> list[str]:
    """Return a sentence for each file of a run that cannot be read."""
    return [f"Damaged: {words}" for words in run.damage]


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
    """Return whether a figure is a mean with its quantiles.

    Example:
        >>> is_spread({"mean": 2.0, "median": 1.0, "p95": 9.0}), is_spread({"mean": {}})
        (True, False)
    """
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
