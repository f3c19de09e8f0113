"""What stands on the page of one run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

from torchrl_hmcts.trainers.experiments.registry import ALL_EXPERIMENTS, field_docs
from torchrl_hmcts.trainers.figures.curve_panels import panel
from torchrl_hmcts.trainers.figures.page_parts import (
    Html,
    drawing,
    grid,
    page,
    picture,
    plain,
    section,
    table,
    text,
)
from torchrl_hmcts.trainers.runs.folder import RunFolder, shown_path
from torchrl_hmcts.trainers.saving.files import left_out


def run_page(run: RunFolder, *, embed: bool = False) -> str:
    """Return the page of a run.

    Args:
        run: the run.
        embed: put its pictures into the page; otherwise the page must lie beside them.

    Returns:
        HTML.
    """
    pictures = [
        picture(run.path / file, words, embed=embed) for file, words in run.pictures.items()
    ]
    panels: list[Html] = []
    with left_out("the curves of the page"):
        panels += [
            drawing(panel(name, {"": [curve]}), name)
            for name, curve in run.curves.items()
            if len(curve.steps) > 1
        ]
    return page(
        run.title or run.name,
        Html(f'<p class="lead">{text(_lead(run))}</p>'),
        damage_of(run),
        grid(pictures, "pictures"),
        section("Figures", result_tables(run.metrics)),
        section("Evaluated again", *map(_evaluation, run.evaluations)),
        section("Curves", grid(panels, "panels")),
        section("Config", config_table(run.experiment, run.config)),
        section("How it was made", made_by(run)),
    )


def damage_of(run: RunFolder) -> Html:
    """Return a sentence for each file of a run that cannot be read."""
    return Html("".join(f'<p class="lead">Damaged: {text(words)}</p>' for words in run.damage))


def result_tables(metrics: Mapping[str, Any]) -> Html:
    """Return figures as tables, one for each group; a mean with its quantiles is one row."""
    return grid((f"<div>{part}</div>" for part in _tables(metrics, "")), "groups")


def _tables(metrics: Mapping[str, Any], prefix: str) -> list[Html]:
    """The table of a group, and those of the groups in it; ``prefix`` ends with a dot."""
    rows: list[tuple[Any, Any]] = []
    inner: list[Html] = []
    for name, value in metrics.items():
        key = Html(f'<span title="{text(prefix + name)}">{text(name.replace("_", " "))}</span>')
        if is_spread(value):
            others = ", ".join(f"{k} {plain(v)}" for k, v in value.items() if k != "mean")
            rows.append((key, Html(f"{text(value['mean'])} <small>{text(others)}</small>")))
        elif name == "unsolved" and isinstance(value, list):  # which mazes, not how many
            rows.append((key, len(value)))
            rows.append(("indices of the unsolved mazes", value))
        elif isinstance(value, Mapping):
            inner += _tables(value, f"{prefix}{name}.")
        elif _are_records(value):
            head = [column.replace("_", " ") for column in value[0]]
            title = (prefix + name).replace(".", ": ").replace("_", " ")
            cells = [
                [x if isinstance(x, int | float) else plain(x) for x in row.values()]
                for row in value
            ]
            shown = table(cells, head)
            inner.append(Html(f"<h3>{text(title)}</h3>" + shown))
        else:
            rows.append((key, value))
    heading = prefix.rstrip(".").replace(".", ": ").replace("_", " ")
    own = [Html((f"<h3>{text(heading)}</h3>" if heading else "") + table(rows))] if rows else []
    return own + inner


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


def flatten(metrics: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return nested figures as one list, names joined by dots.

    Example:
        >>> flatten({"seed": 1, "test": {"solved": 3}})
        [('seed', 1), ('test.solved', 3)]
    """
    rows: list[tuple[str, Any]] = []
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            rows += flatten(value, f"{prefix}{name}.")
        else:
            rows.append((f"{prefix}{name}", value))
    return rows


def config_table(experiment: str, config: Mapping[str, Any]) -> Html:
    """Return the keys with their values and meaning; what is not the default stands out."""
    defaults: dict[str, Any] = {}
    meanings: dict[str, str] = {}
    if experiment in ALL_EXPERIMENTS:
        config_class = ALL_EXPERIMENTS[experiment].config_class
        defaults = {field.name: field.default for field in fields(config_class)}
        meanings = field_docs(config_class)
    rows = []
    for key, value in config.items():
        shown = text(shown_path(value) if isinstance(value, str) else _exact(value))
        if key in defaults and value != defaults[key]:
            was = text(_exact(defaults[key]))
            shown = f'<span class="changed" title="default: {was}">{shown}</span>'
        rows.append((Html(f"<code>{text(key)}</code>"), Html(shown), meanings.get(key, "")))
    return table(rows, ("key", "value", "meaning"), "stack") if rows else Html("")


def made_by(run: RunFolder) -> Html:
    """Return command, versions and machine."""
    commands = "".join(f"<pre>{text(c)}</pre>" for c in run.record.get("commands", []))
    facts = []
    versions = run.record.get("versions") or {}
    if versions:
        facts.append(("versions", ", ".join(f"{k} {v}" for k, v in versions.items())))
    machine = run.record.get("machine") or {}
    if machine:
        facts.append(("machine", f"{machine.get('cpus')} CPUs, {machine.get('platform')}"))
    if run.status:
        facts.append(("status", run.status))
    return Html(commands + (table(facts) if facts else ""))


def _lead(run: RunFolder) -> str:
    words = [run.experiment] if run.experiment else []
    if run.seed is not None:
        words.append(f"seed {run.seed}")
    if not run.finished:
        words.append(f"not finished ({run.status})" if run.status else "not finished")
    if run.config.get("toy"):
        words.append("toy size: shows that everything works, not what can be reached")
    return ", ".join(words)


def _evaluation(evaluation: Mapping[str, Any]) -> Html:
    changes = ", ".join(f"{k}={_exact(v)}" for k, v in evaluation.get("changes", {}).items())
    heading = f"<h3>{text(changes or 'with the config of the run')}</h3>"
    command = f"<pre>{text(evaluation.get('command', ''))}</pre>"
    return Html(heading + command + result_tables(evaluation.get("results", {})))


def _exact(value: Any) -> str:
    """As it would be typed."""
    return str(value).lower() if isinstance(value, bool) else str(value)
