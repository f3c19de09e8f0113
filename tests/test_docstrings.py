"""The examples in the docstrings run, and everything public has one.

Modules are found and imported by name: by path, each class of a mapped folder would exist twice.
"""

from __future__ import annotations

import ast
import dataclasses
import doctest
import importlib
import inspect
import pkgutil
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

# An editable install maps the folders: walking `torchrl_hmcts` alone does not reach the last two.
ROOTS = ("torchrl_hmcts", "torchrl_hmcts.envs", "torchrl_hmcts.trainers")
DOCTEST_FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def module_names() -> dict[str, bool]:
    """Maps the name of each module of the project to whether it is a package."""
    found = dict.fromkeys(ROOTS, True)
    for root in ROOTS:
        path = importlib.import_module(root).__path__
        found |= {m.name: m.ispkg for m in pkgutil.walk_packages(path, f"{root}.")}
    return {name: found[name] for name in sorted(found)}


MODULES = module_names()
PACKAGES = [name for name, is_package in MODULES.items() if is_package]


def test_all_three_folders_are_reached() -> None:
    folders = {Path(importlib.import_module(root).__file__ or "").parent for root in ROOTS}
    assert len(folders) == 3
    for folder in folders:
        for path in folder.rglob("*.py"):
            assert path.stem == "__init__" or any(n.endswith(f".{path.stem}") for n in MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_run(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if ".envs.atari." in name:
        pytest.importorskip("ale_py")
    if name.endswith((".gym.features", ".gym.grid_moves")):
        pytest.importorskip("minigrid")
    module = importlib.import_module(name)
    assert module.__doc__, f"{name} has no docstring"
    monkeypatch.chdir(tmp_path)  # an example may write files
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=DOCTEST_FLAGS)
    for example in doctest.DocTestFinder(exclude_empty=True).find(module, name):
        runner.run(example, out=report.append)
    assert not runner.failures, "".join(report)


@pytest.mark.parametrize("name", PACKAGES)
def test_every_package_says_what_is_public(name: str) -> None:
    package = importlib.import_module(name)
    assert all(hasattr(package, public) for public in package.__all__)


def test_public_names_are_exported_once() -> None:
    exported = Counter(
        public
        for name in PACKAGES
        if name != "torchrl_hmcts"  # shortcuts to what the packages export
        for public in importlib.import_module(name).__all__
        if not inspect.ismodule(getattr(importlib.import_module(name), public))
    )
    twice = [public for public, times in exported.items() if times > 1]
    assert not twice, f"exported by more than one package: {twice}"


def public_names(package: str) -> Iterator[tuple[str, Any]]:
    """Yields the classes and functions that a package exports."""
    module = importlib.import_module(package)
    for name in module.__all__:
        value = getattr(module, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            yield name, value


# The packages whose names stand for something that was published, or for this project's own method.
LITERATURE = {
    f"torchrl_hmcts.{name}" for name in ("planners", "objectives", "modules", "transforms", "envs")
}
# In them: data, forms that a user's object has, and tools.
NOTHING_TO_CITE = set(
    "NodeStatistics NoveltyTest Plan PlansGoals Root Search SearchProgress SearchTree Transition "
    "TreeView Evaluation SearchSettings extract_plans OptionWorker TorchRLGymnasiumEnv "
    "free_tiles maze_from_text maze_to_text "
    "shortest_path_lengths Snapshot AttributeSnapshot ReplaySnapshot "
    "SnapshotError option_color".split()
)
# What works on tensors, so that its docstring has to give their shapes.
TENSORS = re.compile(r"\b(Tensor|TensorDict|TensorDictBase|ndarray|Plan|Search)\b")
SHAPE = re.compile(r"\[(\*?[A-Za-z]|\d+[,\]]|\d+ )[^\[\]]*\]|\[\]|scalar|batch of one|any shape")


def docstring(value: Any) -> str:
    """The docstring of a class or function itself, not one it inherits."""
    doc = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    return inspect.cleandoc(doc or "")


def sections(doc: str) -> dict[str, str]:
    """Splits a docstring at its headings, ``Args:`` and others; what precedes them is ``""``."""
    parts = re.split(r"^([A-Z][a-z]+):[ ]*(?=\n)", doc, flags=re.MULTILINE)
    found = {"": parts[0]}
    for heading, text in zip(parts[1::2], parts[2::2], strict=True):
        found[heading] = found.get(heading, "") + text
    return found


def constructor(value: Any) -> Callable[..., Any]:
    """The function that takes the arguments, unwrapped."""
    return inspect.unwrap(value.__init__ if inspect.isclass(value) else value)


def parameters(value: Any) -> list[str]:
    """The names of the arguments that a user may give."""
    if getattr(value, "_is_tensorclass", False):
        return list(value.__annotations__)
    inherits = inspect.isclass(value) and "__init__" not in vars(value)
    if inherits and not dataclasses.is_dataclass(value):
        return list(getattr(value, "_fields", ()))  # else the base class tells
    taken = list(inspect.signature(constructor(value)).parameters.values())
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    own = [p.name for p in taken[inspect.isclass(value) :] if p.kind not in variable]
    return [name for name in own if not name.startswith("_")]


def sentences_below_fields(value: Any) -> set[str]:
    """The fields of a dataclass that have a string below them."""
    from torchrl_hmcts.trainers.runs.config import config_keys

    return (
        set({name for name, (_, said) in config_keys(value).items() if said})
        if dataclasses.is_dataclass(value)
        else set()
    )


def undocumented_parameters(value: Any) -> list[str]:
    parts = sections(docstring(value))
    text = parts.get("Args", "") + parts.get("Attributes", "") + parts.get("Keys", "")
    named = set()
    for line in re.findall(r"^ +([*\w, ]+?)(?: \([^\n]*\))?:(?: |$)", text, re.MULTILINE):
        named |= {name.strip().lstrip("*") for name in line.split(",")}
    missing = [name for name in parameters(value) if name not in named]
    return sorted(set(missing) - sentences_below_fields(value)) if missing else []


def raised(value: Any) -> set[str]:
    """The errors that a function, or the constructor of a class, raises by a line of its own."""
    functions = [value]
    if inspect.isclass(value):
        own = [vars(value).get("__init__"), vars(value).get("__post_init__")]
        functions = [function for function in own if inspect.isfunction(function)]
    functions = [inspect.unwrap(function) for function in functions]
    file = inspect.getfile(value)  # what a decorator made is elsewhere
    functions = [f for f in functions if f.__code__.co_filename == file]
    found = set()
    for function in functions:
        for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(function)))):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                found.add(ast.unparse(node.exc.func))
    return found - {"NotImplementedError", "AssertionError"}


def handles_tensors(value: Any) -> bool:
    if inspect.isclass(value):
        if issubclass(value, torch.nn.Module) or getattr(value, "_is_tensorclass", False):
            return True
        functions = [constructor(value), *(vars(value).get(n) for n in ("__call__", "forward"))]
    else:
        functions = [inspect.unwrap(value)]
    annotations = [
        str(annotation)
        for function in functions
        if inspect.isfunction(function)
        for annotation in function.__annotations__.values()
    ]
    plain = [re.sub(r"(Callable|Iterator|Iterable)\[.*", "", text) for text in annotations]
    return any(TENSORS.search(text) for text in plain)


def bare_methods(value: type) -> list[str]:
    """The public methods that a class of the project defines and that have no docstring."""
    bare = []
    for name, method in vars(value).items():
        function = getattr(method, "fget", None) or getattr(method, "__func__", method)
        own = str(getattr(inspect.unwrap(function), "__module__", "")).startswith("torchrl_hmcts")
        if not name.startswith("_") and inspect.isroutine(function) and own:
            over = [vars(base).get(name) for base in value.__mro__ if base is not torch.nn.Module]
            bare += [] if any(getattr(method, "__doc__", None) for method in over) else [name]
    return bare


def shortcomings(package: str, name: str, value: Any) -> list[str]:
    """What the docstring of a public name lacks."""
    doc = docstring(value)
    if not doc:
        return ["a docstring"]
    parts, found = sections(doc), []
    if not {"Example", "Examples"} & set(parts) or ">>> " not in doc:
        found.append("an Example that runs")
    found.extend(f"parameter {missing}" for missing in undocumented_parameters(value))
    told = parts.get("Raises", "")
    found.extend(
        f"Raises {error}"
        for error in sorted(raised(value))
        if not re.search(rf"\b{error.rpartition('.')[2]}\b", told)
    )
    if package in LITERATURE and name not in NOTHING_TO_CITE and "Reference" not in parts:
        found.append("a Reference")
    if handles_tensors(value) and not SHAPE.search(doc):
        found.append("shapes")
    if inspect.isclass(value):
        found.extend(f"a docstring of {method}" for method in bare_methods(value))
    return found


@pytest.mark.parametrize("name", PACKAGES)
def test_every_docstring_is_complete(name: str) -> None:
    lacking = {
        public: missing
        for public, value in public_names(name)
        if (missing := shortcomings(name, public, value))
    }
    assert not lacking, f"docstrings of {name} that lack something: {lacking}"


def test_names_that_are_excused_are_public() -> None:
    public = {public for package in PACKAGES for public, _ in public_names(package)}
    assert public >= NOTHING_TO_CITE


def test_what_a_docstring_lacks_is_noticed() -> None:
    def doubled(x: torch.Tensor, times: int) -> torch.Tensor:
        """Doubles.

        Args:
            x: what to double.
        """
        if times < 0:
            raise ValueError("times")
        return 2 * x

    found = shortcomings("torchrl_hmcts.planners", "doubled", doubled)
    assert found == [
        "an Example that runs", "parameter times", "Raises ValueError", "a Reference", "shapes",
    ]  # fmt: skip


def test_help_on_a_tensor_class_shows_what_was_written() -> None:
    from torchrl_hmcts.planners import NodeStatistics, Plan, TreeView

    for kind in (Plan, TreeView, NodeStatistics):
        assert "Attributes:" in inspect.getdoc(kind)
