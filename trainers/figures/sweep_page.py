"""The page of a sweep: its trials, how the best of them came, which keys matter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.figures.page_parts import Html, page, picture, section, table, text
from torchrl_hmcts.trainers.figures.pictures import Pictures, save_figure
from torchrl_hmcts.trainers.saving.files import write_text

_COLOR = "#1d4ed8"


def plot_importances(importances: Mapping[str, float], path: str | Path) -> None:
    """Draw how much each key matters, as bars.

    Args:
        importances: share of each key.
        path: PNG to write.
    """
    keys = sorted(importances, key=lambda key: importances[key])
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 0.9 + 0.42 * len(keys)), layout="constrained")
    axes = figure.subplots()
    bars = axes.barh(keys, [importances[key] for key in keys], color=_COLOR, height=0.62)
    axes.bar_label(bars, fmt="{:.0%}", padding=4, fontsize=10)
    axes.set_xlim(0.0, max(1e-9, 1.15 * max(importances.values())))
    axes.set_xticks([])
    axes.spines[["top", "right", "bottom"]].set_visible(False)
    axes.set_title("importance of each key", fontsize=11, loc="left")
    save_figure(figure, path)


def plot_trials(rows: Sequence[Mapping[str, Any]], path: str | Path, *, objective: str) -> None:
    """Draw the figure of every finished trial, and the best so far.

    Args:
        rows: of :func:`~torchrl_hmcts.trainers.runs.sweep.trial_rows`.
        path: PNG to write.
        objective: name of the figure; with a minus before it, less is better.
    """
    done = sorted((row["trial"], row["value"]) for row in rows if row["value"] is not None)
    better = min if objective.startswith("-") else max
    best: list[float] = []
    for _, value in done:
        best.append(better(best[-1], value) if best else value)
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    numbers = [number for number, _ in done]
    axes.plot(numbers, [value for _, value in done], "o", color=_COLOR, alpha=0.55, label="trial")
    axes.step(numbers, best, where="post", color="#d97706", label="best so far")
    axes.set_title(objective.removeprefix("-"), fontsize=11, loc="left")
    axes.set_xlabel("trial")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9)
    save_figure(figure, path)


def write_sweep_page(
    folder: str | Path,
    *,
    experiment: str,
    objective: str,
    rows: Sequence[Mapping[str, Any]],
    importances: Mapping[str, float],
    command: str,
) -> Path:
    """Write the page and pictures of a sweep.

    Args:
        folder: of the sweep.
        experiment: name of the experiment.
        objective: figure that is improved.
        rows: the trials, best first.
        importances: share of each key; may be empty.
        command: that was given.

    Returns:
        The page.
    """
    folder = Path(folder)
    drawn = Pictures(folder)
    if any(row["value"] is not None for row in rows):
        with drawn.one("trials.png", "All finished trials.") as path:
            plot_trials(rows, path, objective=objective)
    if importances:
        words = "What sets the best trials apart from the others (PED-ANOVA)."
        with drawn.one("importances.png", words) as path:
            plot_importances(importances, path)
    items = drawn.captions.items()
    pictures = [picture(folder / name, words, embed=False) for name, words in items]
    keys = list(dict.fromkeys(key for row in rows for key in row["params"]))
    cells = []
    for row in rows:
        name = text(row["folder"])
        link = f'<a href="{name}/index.html">{name}</a>' if name else "-"
        shown = Html(link) if (folder / row["folder"] / "index.html").is_file() else row["folder"]
        why = row["refused"] or row["state"]
        params = [row["params"].get(key) for key in keys]
        cells.append([shown, why, row["value"], *params, row["seconds"]])
    best = next((row for row in rows if row["value"] is not None), None)
    lead = "No trial has finished."
    if best is not None:
        values = " ".join(f"{key}={value}" for key, value in best["params"].items())
        lead = f"Best: {objective.removeprefix('-')} = {best['value']:.6g} with {values}"
    file = folder / "index.html"
    write_text(
        file,
        page(
            f"Sweep of {experiment}",
            Html(f'<p class="lead">{text(lead)}</p>'),
            Html('<div class="pictures">' + "".join(pictures) + "</div>"),
            section("Trials", table(cells, ["trial", "state", objective, *keys, "seconds"])),
            section("How it was made", Html(f"<pre>{text(command)}</pre>")),
        ),
    )
    return file
