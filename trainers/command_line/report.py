"""``hmcts report DIR ...`` and ``hmcts report figure=NAME``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_hmcts.trainers.command_line.running import WRONG_WORDS, Failure, printing, told
from torchrl_hmcts.trainers.command_line.words import folders_of, split_words
from torchrl_hmcts.trainers.experiments.registry import recognise
from torchrl_hmcts.trainers.runs.config import home
from torchrl_hmcts.trainers.saving.run_folder import is_run, read_run

_OWN = ("figure", "out", "results")


def report(words: Sequence[str]) -> int:
    """Write the page of a run, of several compared, or a figure of the dissertation."""
    with told("report", *WRONG_WORDS):
        own, rest = split_words(words, _OWN)
        own |= {key: home(own[key]) for key in ("out", "results") if key in own}
        folders = folders_of(rest, _OWN)
        with printing(own.get("log_level", "info")):
            (_figure if "figure" in own else _pages)(own, folders)
    return 0


def _pages(own: dict[str, str], folders: list[str]) -> None:
    if "results" in own:
        raise ValueError("results=DIR is for figure=NAME.")
    if not folders:
        raise ValueError(
            "say which runs, e.g. hmcts report runs/one (or several, to compare them), or which "
            "figure of the dissertation, e.g. figure=3.6 (all: hmcts list figures)."
        )
    runs = [recognise(read_run(run)) for folder in folders for run in runs_in(folder)]
    if len(runs) > 1:
        from torchrl_hmcts.trainers.figures.comparison_page import write_comparison

        print(f"Page: {write_comparison(runs, own.get('out', 'runs/report'))}")
        return
    from torchrl_hmcts.trainers.figures.run_page import write_run_page

    out = own.get("out")
    if out is not None and not out.lower().endswith((".html", ".htm")):
        out = str(Path(out) / "index.html")
    print(f"Page: {write_run_page(runs[0], out)}")


def runs_in(folder: str) -> list[str]:
    """Return a folder of a run, or the runs that a folder holds.

    Example:
        >>> runs_in("runs/one")
        ['runs/one']
    """
    if is_run(folder):
        return [folder]
    inside = sorted(path.parent for path in Path(folder).glob("*/run.json"))
    inside += sorted(path.parent for path in Path(folder).glob("*/metrics.json"))
    return [str(path) for path in dict.fromkeys(inside)] or [folder]


def _figure(own: dict[str, str], folders: list[str]) -> None:
    from torchrl_hmcts.trainers.experiments.dissertation import MissingData, find_results
    from torchrl_hmcts.trainers.experiments.dissertation_figures import draw_all, draw_figure

    results = find_results(own.get("results"))
    out = Path(own.get("out", "figures"))
    if own["figure"] == "all":
        page, without = draw_all(folders, results, out)
        print(*without, f"Page: {page}", sep="\n")
        return
    try:
        path, caption = draw_figure(own["figure"], folders, results, out)
    except MissingData as error:
        raise Failure(f"hmcts report: {error}") from None
    print(f"{caption}\n{path}")
