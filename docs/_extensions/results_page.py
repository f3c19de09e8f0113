"""Writes the page of results from the data in docs/results, when the site is built.

Every number on it comes from a file there, with the command that made it: the entry ``command`` of
the file, or its row in docs/results/README.md.
"""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from results_atari import ATARI, atari, best, learned, sticky
from results_reliability import RELIABILITY
from results_tables import SECTIONS, Section, table

if TYPE_CHECKING:  # the tests read this module where Sphinx is not installed
    from sphinx.application import Sphinx

RESULTS = Path(__file__).resolve().parents[1] / "results"

_HEAD = """# Results

Every number here is read from the files in `docs/results` when this page is built. Below each table
stand the file it is made of and the command that made that file. Times are of two shared CPU cores
and vary with what else they do; counts of steps and mazes do not.
[Commands and data](../results/README.md) lists all of them in one place.

## Beside the dissertation

What the dissertation reports in numbers or plain words, and what was measured here.

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


_ATARI = {
    "Atari": (
        Section("Seven games", "atari/runs.json", atari),
        Section("Learned workers", "atari/learned.json", learned),
        Section("Sticky actions, whole episodes", "atari/sticky.json", sticky),
    )
}


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
    """Return the page, in Markdown; pictures are named relative to docs/auto_results.

    Args:
        results: folder of the data.
        curves: pictures drawn for this page with their captions, by the file whose data they show.
    """
    listed = commands((results / "README.md").read_text())
    parts, shown = [_HEAD, beside_the_source(results)], set()
    for heading, sections in {**SECTIONS, **_ATARI, "Reliability": RELIABILITY}.items():
        present = [section for section in sections if (results / section.data).exists()]
        if not present:
            continue
        parts.append(f"## {heading}\n")
        for section in present:
            parts.append(_section(section, results, listed, (curves or {}).get(section.data, {})))
            shown |= {section.data, *section.also, *(name for name, _ in section.pictures)}
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
        text = section.write(data)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(
            f"docs/results/{section.data} is not what results_tables.{section.write.__name__} "
            f"reads ({error!r}). Change the function to the file's new form."
        ) from error
    made = command_of(section.data, data, listed)
    lines = [f"{'#' * section.level} {section.title}\n", text]
    lines.append(f"[{section.data}](../results/{section.data}): {made}\n")
    pictures = dict(curves)
    for name, caption in section.pictures:
        if (results / name).exists():
            pictures[f"../results/{name}"] = caption
    for name, caption in pictures.items():
        shown = caption or section.title
        lines.append(f":::{{figure}} {name}\n:alt: {shown}\n\n{caption}\n:::\n")
    return "\n".join(lines)


def beside_the_source(results: Path = RESULTS) -> str:
    """Return the table that sets our figures beside those of the dissertation."""
    rows = []
    goals, lab = results / "goals/goal_agent.json", results / "lab/labmaze.json"
    if goals.exists():
        runs = load(goals)["agents"]["goal-based agent"]
        tests = [run["test"] for run in runs]
        rows.append(
            [
                "goal-based agent in Waterworld's mazes (figure 3.6)",
                "solves them consistently and quickly",
                ", ".join(str(test["solved"]) for test in tests)
                + f" of {tests[0]['mazes']} unseen mazes, "
                + ", ".join(f"{test['base_steps_mean']:.0f}" for test in tests)
                + " base steps",
                len(runs),
            ]
        )
    if lab.exists():
        found = {
            k: v for k, v in load(lab)["results"].items() if re.fullmatch(r"diayn \d+ size 9", k)
        }
        frames = [v for k, v in load(lab)["results"].items() if k.endswith("training")]
        rows.append(
            [
                "DeepMind Lab's random maze, 9 x 9 (figure 4.10)",
                "every maze at the first trial after about 40,000 training steps",
                ", ".join(f"{v['solved']} of {v['mazes']}" for v in found.values())
                + f" at the first trial after {frames[0]['frames']:,} frames",
                len(found),
            ]
        )
    text = table(["experiment", "dissertation", "here", "seeds here"], rows)
    path = results / "atari/runs.json"
    runs = load(path) if path.exists() else []
    games = [[*row[:2], row[4], f"{row[2]} x {row[3]}", best(runs, row[0])] for row in ATARI]
    return (
        text
        + "\nAtari (table 5.1: highest score in 10 million time steps, 6 seeds; table A.1: best "
        + "mean of seven algorithms of OpenAI Baselines):\n\n"
        + table(
            ["game", "dissertation", "best of Baselines", "its options x base steps", "here, best"],
            games,
        )
    )


def setup(app: Sphinx) -> dict[str, Any]:
    def write(app: Sphinx) -> None:
        from results_curves import draw_curves

        folder = Path(app.srcdir, "auto_results")
        folder.mkdir(exist_ok=True)
        (folder / "index.md").write_text(page(RESULTS, draw_curves(RESULTS, folder)))

    app.connect("builder-inited", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
