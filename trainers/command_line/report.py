"""``hmcts report DIR ...`` and ``hmcts report figure=NAME``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_hmcts.trainers.command_line.running import fail, missing, refuse, said
from torchrl_hmcts.trainers.command_line.words import folders_of, split_words
from torchrl_hmcts.trainers.experiments.registry import recognise
from torchrl_hmcts.trainers.runs.config import home
from torchrl_hmcts.trainers.saving.run_folder import read_run

_OWN = ("figure", "out", "results")


def report(words: Sequence[str]) -> int:
    """Write the page of a run, of several compared, or a figure of the dissertation."""
    try:
        own, rest = split_words(words, _OWN)
        own |= {key: home(own[key]) for key in ("out", "results") if key in own}
        folders = folders_of(rest, _OWN)
        with said(own.get("log_level", "info")):
            if "figure" in own:
                return _figure(own, folders)
            return _pages(own, folders)
    except ModuleNotFoundError as error:
        return missing(error)
    except (ValueError, KeyError) as error:
        return refuse("report", error)
    except OSError as error:
        return fail("report", f"{error}. Choose another place with out=DIR.")


def _pages(own: dict[str, str], folders: list[str]) -> int:
    if "results" in own:
        raise ValueError("results=DIR is for figure=NAME.")
    if not folders:
        raise ValueError(
            "say which runs, e.g. hmcts report runs/one (or several, to compare them), or which "
            "figure of the dissertation, e.g. figure=3.6 (all: hmcts list figures)."
        )
    runs = [recognise(read_run(folder)) for folder in folders]
    if len(runs) == 1:
        from torchrl_hmcts.trainers.figures.run_page import write_run_page

        out = own.get("out")
        if out is not None and not out.lower().endswith((".html", ".htm")):
            out = str(Path(out) / "index.html")
        print(f"Page: {write_run_page(runs[0], out)}")
        return 0
    from torchrl_hmcts.trainers.figures.comparison_page import write_comparison

    print(f"Page: {write_comparison(runs, own.get('out', 'runs/report'))}")
    return 0


def _figure(own: dict[str, str], folders: list[str]) -> int:
    from torchrl_hmcts.trainers.experiments.dissertation import MissingData, find_results
    from torchrl_hmcts.trainers.experiments.dissertation_figures import draw_all, draw_figure

    results = find_results(own.get("results"))
    out = Path(own.get("out", "figures"))
    if own["figure"] == "all":
        page, without = draw_all(folders, results, out)
        for message in without:
            print(message)
        print(f"Page: {page}")
        return 0
    try:
        path, caption = draw_figure(own["figure"], folders, results, out)
    except MissingData as error:
        return fail("report", error)
    print(f"{caption}\n{path}")
    return 0
