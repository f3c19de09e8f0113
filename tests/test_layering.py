"""The direction of all imports, lazy and typing-only ones included, and no circle of files."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TOP = "torchrl_hmcts"
FOLDERS = {TOP: TOP, "envs": f"{TOP}.envs", "trainers": f"{TOP}.trainers"}
# Rooms by the pattern of their modules, the first that fits, and the rooms that each may import,
# with all below these. Packages that export their parts are rooms of their own.
PARTS = ["testing", "planners", "transforms"]
ROOMS: dict[str, tuple[str, list[str]]] = {
    "command line": (r"trainers\.(command_line|cli|configs|__main__)", ["agent"]),
    "agent": (r"trainers\.agent", ["experiments"]),
    "experiments": (r"trainers\.experiments", ["runs", "all envs"]),
    "runs": (r"trainers\.runs", ["figures", "algorithms"]),
    "figures": (r"trainers\.figures", ["saving", "all envs", *PARTS]),
    "saving": (r"trainers\.saving", ["base"]),
    "algorithms": (r"trainers\.\w+", ["saving", "all envs", *PARTS]),
    "all trainers": (r"trainers", ["command line"]),
    "mazes": (r"envs\.mazes", ["shared envs"]),
    "lab": (r"envs\.lab", ["mazes"]),
    "gym": (r"envs\.gym", ["shared envs", "modules"]),
    "atari": (r"envs\.atari", ["gym"]),
    "shared envs": (r"envs\.\w+", ["base"]),
    "all envs": (r"envs", ["lab", "atari"]),
    "testing": (r"testing", ["planners", "transforms"]),
    "transforms": (r"transforms", ["objectives"]),
    "objectives": (r"objectives", ["modules"]),
    "modules": (r"modules", ["env parts"]),
    "planners": (r"planners", ["env parts"]),
    "env parts": (r"nesting|carried_state|direct_calls", ["base"]),
    "base": (r"checks|compiling|notebook|processes|", []),
}
DEPENDENCIES = {"torch", "tensordict", "torchrl", "numpy", "numba"}  # of components
# What a component may import inside a function, for those who have it.
OPTIONAL = {
    "notebook": "matplotlib",
    "planners.drawing": "matplotlib",
    "planners.export": "networkx",
}
# What is still wrong today: lines go, and none comes.
KNOWN = {
    "envs.gym_envs": "lab mazes",
}
KNOWN_CIRCLES: set[str] = set()


def modules() -> dict[str, Path]:
    """Map each module's import name to its file, over all three folders."""
    found = {}
    for folder, package in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            found[".".join((package, *parts))] = path
    return found


MODULES = modules()


def outside_functions(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a syntax tree that run when the module is imported."""
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            yield node
            yield from outside_functions(node)


def imported(source: str, module: str, is_package: bool, at_import: bool = False) -> set[str]:
    """Return the absolute names of all that a module imports; of ``from a import b`` it is a.b.

    With ``at_import``, only what is imported along with the module, not by its functions.
    """
    package = module.split(".") if is_package else module.split(".")[:-1]
    names = set()
    tree = ast.parse(source)
    for node in outside_functions(tree) if at_import else ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, node.module] if node.module else base
            names.update(".".join([*base, alias.name]) for alias in node.names)
        elif isinstance(node, ast.Call) and node.args:
            called = getattr(node.func, "attr", getattr(node.func, "id", None))
            name = getattr(node.args[0], "value", None)
            loads = called in ("import_module", "__import__", "find_spec")
            names |= {name} if loads and isinstance(name, str) else set()
    return names


def module_of(name: str) -> str:
    """Return the module that an imported name is, or is in."""
    while name not in MODULES and "." in name:
        name = name.rpartition(".")[0]
    return name


def room(module: str) -> str:
    inner = module.removeprefix(TOP).lstrip(".")
    fits = (n for n, (pattern, _) in ROOMS.items() if re.fullmatch(rf"({pattern})(\..*)?", inner))
    return next(fits)


def reach(name: str) -> set[str]:
    """Return a room and all below it."""
    return {name}.union(*map(reach, ROOMS[name][1]))


def is_component(module: str) -> bool:
    return not module.startswith((f"{TOP}.envs", f"{TOP}.trainers"))


def wrong(source: str, module: str, is_package: bool = False) -> set[str]:
    """Return the rooms, or the packages of others, that a module imports and may not."""
    found = set()
    at_import = imported(source, module, is_package, at_import=True)
    for name in imported(source, module, is_package):
        top = name.split(".")[0]
        if top == TOP:
            found |= {room(module_of(name))} - reach(room(module))
        elif is_component(module) and top not in DEPENDENCIES | set(sys.stdlib_module_names):
            optional = OPTIONAL.get(module.removeprefix(f"{TOP}."))
            found |= set() if top == optional and name not in at_import else {top}
    return found


def circles(edges: Mapping[str, set[str]]) -> list[str]:
    """Return circles of files, each found after an import of the last one was cut."""
    edges, found = {k: set(v) for k, v in edges.items()}, []
    while True:
        try:
            TopologicalSorter(edges).prepare()
            return found
        except CycleError as error:
            circle = error.args[1][:0:-1]  # each imports the next
            found.append(" ".join(name.removeprefix(f"{TOP}.") for name in circle))
            edges[circle[0]].discard(circle[1] if len(circle) > 1 else circle[0])


IMPORTS = {m: imported(p.read_text(), m, p.name == "__init__.py") for m, p in MODULES.items()}


def test_a_module_imports_only_what_its_room_may() -> None:
    found = {}
    for module, path in MODULES.items():
        known = KNOWN.get(module.removeprefix(f"{TOP}."), "")
        rooms = wrong(path.read_text(), module, path.name == "__init__.py")
        found[module] = {name for name in rooms if name not in known}
    assert {module: rooms for module, rooms in found.items() if rooms} == {}


def test_no_file_imports_one_that_imports_it() -> None:
    edges = {}
    for module, names in IMPORTS.items():
        edges[module] = {module_of(n) for n in names if n.split(".")[0] == TOP} - {module}
    assert set(circles(edges)) - KNOWN_CIRCLES == set()


LAZY = "def f():\n    "
TYPING = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    "


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("planners.mcts", "from torchrl_hmcts import envs"),
        ("planners.mcts", "from ..envs import mazes"),
        ("planners.mcts", f"{LAZY}from torchrl_hmcts import trainers"),
        ("planners.mcts", f"{TYPING}from torchrl_hmcts.transforms import OptionTransform"),
        ("planners.mcts", "import_module('torchrl_hmcts.trainers.cli')"),
        ("planners.mcts", "import pymunk"),
        ("planners.tree", f"{LAZY}import networkx"),
        ("planners.drawing", "if True:\n    import matplotlib"),
        ("planners.export", f"{LAZY}import matplotlib"),
        ("modules.skill_mlp", "from torchrl_hmcts.objectives import DIAYNLoss"),
        ("envs.mazes.layouts", "from torchrl_hmcts.planners import MCTSPlanner"),
        ("envs.mazes.layouts", "from .. import testing\nfrom ...nesting import parts"),
        ("envs.gym.settable", f"{LAZY}from torchrl_hmcts.envs.atari import pool"),
        ("trainers.saving.files", f"{TYPING}from torchrl_hmcts.trainers import DIAYNTrainer"),
        ("trainers.a3c.trainer", f"{LAZY}from torchrl_hmcts.trainers.figures import report"),
        ("trainers.diayn", f"{LAZY}from torchrl_hmcts.trainers.runs import folder"),
        ("trainers.figures.plots", "from torchrl_hmcts.trainers.experiments import demo"),
        ("trainers.experiments.skills", f"{LAZY}from torchrl_hmcts.trainers import cli"),
    ],
)
def test_the_check_catches_a_violation(module: str, source: str) -> None:
    assert wrong(source, f"{TOP}.{module}")


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("planners.mcts", "import math\nimport torch\nfrom torchrl.envs import EnvBase"),
        ("planners.mcts", "from .tree import SearchTree\nfrom ..nesting import parts"),
        ("planners.drawing", f"{LAZY}from matplotlib import pyplot"),
        ("envs.mazes.layouts", "import pymunk\nfrom . import rendering"),
        ("envs.atari.pool", "from torchrl_hmcts.envs.gym import settable"),
        ("trainers.experiments.skills", "from torchrl_hmcts import envs, planners"),
        ("trainers.cli", "from torchrl_hmcts.trainers.saving.files import x"),
    ],
)
def test_the_check_lets_the_right_direction_pass(module: str, source: str) -> None:
    assert not wrong(source, f"{TOP}.{module}")


def test_circles_of_any_length_are_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    assert len(circles({"a": {"b"}, "b": {"c"}, "c": {"a"}})) == 1
    assert len(circles({"a": {"b"}, "b": {"a"}, "c": {"d"}, "d": {"c"}})) == 2
