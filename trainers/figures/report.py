"""The page of a run: its figures, pictures, curves and config in one HTML file."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import sys
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from torchrl_hmcts import __version__
from torchrl_hmcts.trainers.figures.foreign_files import refuse_foreign
from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.runs.folder import RunFolder, is_run, read_run
from torchrl_hmcts.trainers.saving.files import left_out, write_json, write_text

_PACKAGES = ("torch", "torchrl", "tensordict", "numpy")


def versions() -> dict[str, str]:
    """Return the versions that a run's figures depend on, by package.

    Example:
        >>> sorted(versions())
        ['numpy', 'python', 'tensordict', 'torch', 'torchrl', 'torchrl_hmcts']
    """
    return {
        "torchrl_hmcts": __version__,
        **{name: metadata.version(name) for name in _PACKAGES},
        "python": platform.python_version(),
    }


def machine() -> dict[str, Any]:
    """Return what a run's times depend on; nothing that names the machine or its folders.

    Example:
        >>> sorted(machine())
        ['cpus', 'platform']
    """
    return {
        "cpus": os.cpu_count(),
        "platform": f"{platform.system()} {platform.machine()}".strip(),
    }


@contextlib.contextmanager
def finish(out: Path, title: str, metrics: Mapping[str, Any]) -> Iterator[Pictures]:
    """Write what a run leaves: ``metrics.json`` first, then pictures, then the page.

    What cannot be drawn or written is left out, with a line on stderr; the figures are printed
    where ``metrics.json`` cannot be written, e.g. to a full disk.

    Args:
        out: folder of the run.
        title: heading of the page.
        metrics: figures by name.

    Yields:
        The pictures to draw.
    """
    written = False
    with left_out("metrics.json"):
        write_json(out / "metrics.json", metrics)
        written = True
    if not written:
        print(json.dumps(metrics, indent=1, default=str))
    pictures = Pictures(out)
    with left_out("what was still to be drawn"):
        yield pictures
    with left_out("index.html"):
        write_page(out / "index.html", title=title, metrics=metrics, pictures=pictures.captions)
        print(f"Pictures and figures: {out / 'index.html'}")


def write_page(
    path: Path, *, title: str, metrics: Mapping[str, Any], pictures: Mapping[str, str]
) -> None:
    """Write a run's page, and beside it what it takes to write it anew; everything is escaped.

    Args:
        path: file to write; pictures, curves and ``run.json`` lie beside it.
        title: heading of the page.
        metrics: figures by name; nested mappings become tables of their own. The entries
            ``"config"`` and ``"versions"`` are shown where there is no ``run.json``.
        pictures: caption of each picture file.
    """
    write_json(path.parent / "page.json", {"title": title, "pictures": dict(pictures)})
    run = RunFolder(path.parent)
    if any((path.parent / name).is_file() for name in ("run.json", "metrics.json")):
        run = read_run(path.parent)
    for name in ("config", "versions"):
        run.record.setdefault(name, metrics.get(name, {}))
    run.metrics = {k: v for k, v in metrics.items() if k not in ("config", "versions")}
    run.title, run.pictures = title, dict(pictures)
    write_text(path, render_run(run))


def write_run_page(path: str | Path, out: str | Path | None = None) -> Path:
    """Write the page of a run from what is in its folder, finished or not.

    Args:
        path: the folder.
        out: file to write; pictures are embedded then. Default: ``index.html`` in the folder,
            beside its pictures.

    Returns:
        The file.

    Raises:
        ValueError: if it is no folder of a run, or ``out`` is the page of another run or a file
            that this package did not write.
    """
    run = read_run(path)
    say_damage(run)
    file = run.path / "index.html" if out is None else Path(out)
    if out is not None and file.name == "index.html" and is_run(file.parent):
        if not file.parent.samefile(run.path):
            raise ValueError(f"{file} is the page of another run. Choose another place with out=.")
    refuse_foreign(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_text(file, render_run(run, embed=out is not None))
    return file


def say_damage(*runs: RunFolder) -> None:
    """Say on stderr which files of runs cannot be read; their pages say so too."""
    for run in runs:
        for sentence in run.damage:
            print(sentence, file=sys.stderr)


def render_run(run: RunFolder, *, embed: bool = False) -> str:
    """Return the page of a run; see :func:`~torchrl_hmcts.trainers.figures.run_page.run_page`."""
    from torchrl_hmcts.trainers.figures.run_page import run_page  # draws: loads matplotlib

    return run_page(run, embed=embed)
