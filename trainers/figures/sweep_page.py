"""The page of a sweep: its trials, how the best of them came, which keys matter."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_hmcts.trainers.figures.pages import Cell, Section, Table, picture, write_sections
from torchrl_hmcts.trainers.figures.pictures import Pictures, save_figure

if TYPE_CHECKING:
    from optuna import Study


def write_sweep_page(
    folder: str | Path,
    *,
    study: Study,
    experiment: str,
    objective: str,
    rows: Sequence[Mapping[str, Any]],
    importances: Mapping[str, float],
    command: str,
) -> Path:
    """Write the page of a sweep, with Optuna's own pictures of its study."""
    folder = Path(folder)
    drawn = Pictures(folder)
    name = objective.removeprefix("-")
    best = next((row for row in rows if row["value"] is not None), None)
    if best is not None:
        with drawn.one("trials.png", "All finished trials, and the best so far.") as path:
            from optuna.visualization.matplotlib import plot_optimization_history

            _save(path, plot_optimization_history, study, target_name=name)
    if importances:
        words = "What sets the best trials apart from the others (PED-ANOVA)."
        with drawn.one("importances.png", words) as path:
            from optuna.importance import PedAnovaImportanceEvaluator
            from optuna.visualization.matplotlib import plot_param_importances

            evaluator = PedAnovaImportanceEvaluator()
            _save(path, plot_param_importances, study, evaluator=evaluator, target_name=name)
    lead = "No trial has finished." if best is None else best_words(rows, objective)
    keys = list(dict.fromkeys(key for row in rows for key in row["params"]))
    cells = []
    for row in rows:
        page = f"{row['folder']}/index.html"
        there = bool(row["folder"]) and (folder / page).is_file()
        shown = Cell(row["folder"], link=page) if there else row["folder"] or "-"
        why = row["refused"] or row["state"]
        params = [row["params"].get(key) for key in keys]
        cells.append([shown, why, row["value"], *params, row["seconds"]])
    head = ["trial", "state", objective, *keys, "seconds"]
    shown_pictures = [picture(folder / file, c, embed=False) for file, c in drawn.captions.items()]
    sections = [
        Section(words=[lead], pictures=shown_pictures),
        Section("Trials", tables=[Table(cells, head)]),
        Section("How it was made", code=[command]),
    ]
    write_sections(folder / "index.html", f"Sweep of {experiment}", sections)
    return folder / "index.html"


def best_words(rows: Sequence[Mapping[str, Any]], objective: str) -> str:
    """Say which trials of a sweep were best; several that are equal are all named."""
    best = [row for row in rows if row["value"] == rows[0]["value"]]
    values = [" ".join(f"{key}={v}" for key, v in row["params"].items()) for row in best]
    lead = f"Best of {len(rows)} trials: {objective.removeprefix('-')} = {rows[0]['value']:.6g}"
    if len(best) == 1:
        return f"{lead} with {values[0]}"
    lines = [f"  trial {row['trial']}: {text}" for row, text in zip(best, values, strict=True)]
    return "\n".join([f"{lead}, reached by {len(best)} trials:", *lines])


def _save(path: Path, draw: Callable[..., Any], study: Study, **options: Any) -> None:
    """Write a plot of Optuna, which draws with pyplot in a style of its own."""
    from matplotlib import pyplot, rc_context

    with rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that these plots are experimental
        figure = draw(study, **options).figure
        try:
            figure.set_layout_engine("constrained")
            save_figure(figure, path)
        finally:
            pyplot.close(figure)
