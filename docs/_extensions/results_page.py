"""Writes the page of results from the data in docs/results, when the site is built.

How a file was made: its entry ``command``, or its row in docs/results/README.md.
"""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from results_tables import SECTIONS, Section

if TYPE_CHECKING:  # the tests read this module where Sphinx is not installed
    from sphinx.application import Sphinx

RESULTS = Path(__file__).resolve().parents[1] / "results"

_HEAD = """# Results

Every number here is read from the files in `docs/results` when this page is built. Below each table
stand the file it is made of and the command that made that file. Times are of two shared CPU cores
and vary with what else they do; counts of steps and mazes do not.
[Commands and data](../results/README.md) lists all of them in one place, and sets them beside the
dissertation's.

"""


def load(path: Path) -> Any:
    """Return the content of a JSON or CSV file."""
    if path.suffix == ".csv":
        with path.open(newline="") as file:
            return list(csv.DictReader(file))
    return json.loads(path.read_text())


def commands(readme: str) -> dict[str, str]:
    """Return the text in the second column of the table in docs/results/README.md, by file.

    A row may name several files, a folder (``demo/``), a suffix (``.png``) or a pattern in which N
    stands for numbers.
    """
    rows = re.findall(r"^\| (`[^|]*) \| (.*) \|$", readme, flags=re.MULTILINE)
    found = {}
    for names, text in rows:
        last = ""
        for name in re.findall(r"`([^`]+)`", names):
            folder, stem = last.rpartition("/")[0], last.rpartition(".")[0]
            if name.startswith("."):
                name = stem + name
            elif "/" not in name and folder:
                name = f"{folder}/{name}"
            found[name], last = text, name
    return found


def command_of(name: str, data: Any, listed: dict[str, str]) -> str:
    """Return how a file was made, as Markdown; empty if nothing says so."""
    if isinstance(data, dict) and "command" in data:
        command = str(data["command"])
        full = listed.get(name, "")
        return full if full.startswith(f"`{command}") else f"`{command}`"
    if name in listed:
        return listed[name]
    for pattern, text in listed.items():
        if re.fullmatch(re.escape(pattern).replace("N", r"\d+"), name):
            return text
        if pattern.endswith("/") and name.startswith(pattern):
            return text
    return ""


def page(results: Path = RESULTS, curves: dict[str, dict[str, str]] | None = None) -> str:
    """Return the page, in Markdown; pictures are named relative to docs/auto_results."""
    listed = commands((results / "README.md").read_text())
    parts, shown = [_HEAD], set()
    for heading, sections in SECTIONS.items():
        present = [section for section in sections if (results / section.data).exists()]
        if not present:
            continue
        parts.append(f"## {heading}\n")
        for section in present:
            parts.append(_section(section, results, listed, (curves or {}).get(section.data, {})))
            shown |= {section.data, *section.also, *section.pictures}
    left = [name for name in data_files(results) if name not in shown]
    if left:
        parts.append("## Further data\n")
        parts.append("Measured, and not yet a table of this page:\n")
        for name in left:
            data = load(results / name) if name.endswith((".json", ".csv")) else None
            made = command_of(name, data, listed)
            parts.append(f"- [{name}](../results/{name})" + (f": {made}" if made else ""))
    return "\n".join(parts) + "\n"


def data_files(results: Path = RESULTS) -> list[str]:
    """Return the names of all data and pictures, relative to the folder."""
    return sorted(
        path.relative_to(results).as_posix()
        for path in results.rglob("*")
        if path.suffix in {".json", ".csv", ".png", ".gif", ".svg"}
    )


def _section(
    section: Section, results: Path, listed: dict[str, str], curves: dict[str, str]
) -> str:
    data = load(results / section.data)
    try:
        text = section.text(data)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(
            f"docs/results/{section.data} is not what its section in results_tables.py reads "
            f"({error!r}). Change the section to the file's new form."
        ) from error
    made = command_of(section.data, data, listed)
    lines = [f"### {section.title}\n", text]
    lines.append(f"[{section.data}](../results/{section.data}): {made}\n")
    pictures = dict(curves)
    for name, caption in section.pictures.items():
        if (results / name).exists():
            pictures[f"../results/{name}"] = caption
    for name, caption in pictures.items():
        shown = caption or section.title
        lines.append(f":::{{figure}} {name}\n:alt: {shown}\n\n{caption}\n:::\n")
    return "\n".join(lines)


def draw_games(folder: Path) -> dict[str, str]:
    """Write the dissertation's figures 5.1 to 5.7 into a folder; return captions by file."""
    from torchrl_hmcts.trainers.experiments.dissertation_figures import draw_figure

    drawn = [draw_figure(f"5.{number}", [], RESULTS, folder) for number in range(1, 8)]
    return {path.name: f"Figure 5.{n}. {caption}" for n, (path, caption) in enumerate(drawn, 1)}


def setup(app: Sphinx) -> dict[str, Any]:
    def write(app: Sphinx) -> None:
        folder = Path(app.srcdir, "auto_results")
        folder.mkdir(exist_ok=True)
        drawn = {"atari/runs.json": draw_games(folder)}
        (folder / "index.md").write_text(page(RESULTS, drawn))

    app.connect("builder-inited", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
