"""Draws docs/_static/house.svg from the imports: the rooms of the code, and who uses whom.

A room stands above every room that it imports; arrows that a longer way repeats are left out.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
matplotlib.rcParams.update({"svg.hashsalt": "house", "svg.fonttype": "none", "font.size": 10})
import matplotlib.pyplot as plt  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = {
    "torchrl_hmcts.envs": "envs",
    "torchrl_hmcts.trainers": "trainers",
    "torchrl_hmcts": "torchrl_hmcts",
}
COLORS = {"torchrl_hmcts": "#a9cdf0", "envs": "#ffcf70", "trainers": "#ffffff"}
ALGORITHMS = re.compile(r"a3c|skills|diayn|hmcts|expert_iteration|evaluation|collectors|off_policy")


def room_of(path: Path) -> str:
    """Return the room of a file: its folder, two levels deep, with the trainers' own joined."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    if parts[0] == "trainers":
        if ALGORITHMS.fullmatch(parts[1]):
            return "trainers/algorithms"
        if parts[1] == "parts":
            return "trainers/experiments"
        if parts[1] in ("cli", "command_line", "configs"):
            return "trainers/command line"
    return "/".join(parts[:2]) if len(parts) > 2 else parts[0]


def file_of(name: str) -> Path | None:
    """Return the file that an import's dotted name means, if it is one of ours."""
    for package, folder in FOLDERS.items():
        if name == package or name.startswith(package + "."):
            inside = name[len(package) :].strip(".").replace(".", "/")
            for path in (ROOT / folder / f"{inside}.py", ROOT / folder / inside / "__init__.py"):
                if path.is_file():
                    return path
    return None


def imported_files(path: Path) -> set[Path]:
    """Return the files of ours that a file imports; a name that a package hands out, by its own."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {file_of(alias.name) for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                file = file_of(f"{node.module}.{alias.name}") or file_of(node.module)
                if file is not None and file.name == "__init__.py" and file != path:
                    file = handed_out(file).get(alias.name, file)
                found.add(file)
    return {file for file in found if file is not None}


@cache
def handed_out(package: Path) -> dict[str, Path]:
    """Return the file that defines each name which a package's ``__init__.py`` hands out."""
    return {
        alias.name: file
        for node in ast.walk(ast.parse(package.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and (file := file_of(node.module or ""))
        for alias in node.names
    }


def read_house() -> tuple[Counter[str], dict[str, set[str]]]:
    """Return the lines of every room, and the rooms that each imports."""
    lines: Counter[str] = Counter()
    uses: dict[str, set[str]] = {}
    for folder in FOLDERS.values():
        for path in (ROOT / folder).rglob("*.py"):
            room = room_of(path)
            lines[room] += path.read_text(encoding="utf-8").count("\n")
            if path.name == "__init__.py":  # it only hands names out
                continue
            uses.setdefault(room, set()).update(map(room_of, imported_files(path)))
    for room, others in uses.items():
        others -= {room, "envs", "trainers"}
    return lines, uses


def floors(uses: dict[str, set[str]]) -> dict[str, int]:
    """Return how far above the ground each room stands."""
    height = dict.fromkeys(uses, 0)
    for _ in uses:
        for room, others in uses.items():
            height[room] = max([height[room], *(height[o] + 1 for o in others if o in uses)])
    if max(height.values()) >= len(uses):
        raise ValueError("Rooms import each other in a circle; tests/test_layering.py names them.")
    return height


def draw(path: Path) -> None:
    """Draw the house as an SVG file."""
    lines, uses = read_house()
    height = floors(uses)
    by_floor = [
        [r for r in sorted(uses) if height[r] == f] for f in range(max(height.values()) + 1)
    ]
    figure, axes = plt.subplots(figsize=(10, 1.25 * len(by_floor)))
    place: dict[str, tuple[float, float]] = {}
    for floor, rooms in enumerate(by_floor):  # each above the middle of what it uses
        middle = {r: sum(place[o][0] for o in uses[r]) / max(len(uses[r]), 1) for r in rooms}
        for i, room in enumerate(sorted(rooms, key=lambda room: (middle[room], room))):
            place[room] = ((i + 0.5) / len(rooms), float(floor))
    arrow = {
        "arrowstyle": "-|>",
        "color": "#8a8f98",
        "linewidth": 0.8,
        "shrinkA": 22,
        "shrinkB": 22,
    }
    for room, (x, y) in place.items():
        for other in uses[room]:
            if not any(other in uses[p] for p in uses[room] if p != other):
                axes.annotate("", place[other], (x, y), zorder=1, arrowprops=arrow)
        name = {"torchrl_hmcts": "base", "envs": "ids, stateless"}.get(room, room.split("/")[-1])
        box = {"facecolor": COLORS[room.split("/")[0]], "edgecolor": "#444b55", "linewidth": 0.8}
        text = f"{name}\n{lines[room]:,} lines"
        axes.text(x, y, text, ha="center", va="center", zorder=3, bbox={"pad": 6.0, **box})
    handles = [plt.Rectangle((0, 0), 1, 1, facecolor=color) for color in COLORS.values()]
    axes.legend(handles, COLORS, loc="upper left", frameon=False, ncols=3)
    axes.set(xlim=(0, 1), ylim=(-0.4, len(by_floor) - 0.2))
    axes.axis("off")
    figure.savefig(path, bbox_inches="tight", metadata={"Date": None})


if __name__ == "__main__":
    draw(ROOT / "docs" / "_static" / "house.svg")
