"""The examples in the docstrings run, and everything public has one.

Modules are found and imported by name: by path, each class of a mapped folder would exist twice.
"""

from __future__ import annotations

import ast
import dataclasses
import doctest
import functools
import importlib
import importlib.util
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


def submodules(package: str, folder: str) -> dict[str, bool]:
    """Maps the name of each module under a package to whether it is a package; imports none."""
    found = {}
    for module in pkgutil.iter_modules([folder]):
        name = f"{package}.{module.name}"
        found[name] = module.ispkg
        if module.ispkg:
            found.update(submodules(name, str(Path(folder, module.name))))
    return found


def module_names() -> dict[str, bool]:
    """Maps the name of each module of the project to whether it is a package."""
    found = dict.fromkeys(ROOTS, True)
    for root in ROOTS:
        spec = importlib.util.find_spec(root)
        for folder in (spec and spec.submodule_search_locations) or ():
            found.update(submodules(root, folder))
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
    module = importlib.import_module(name)
    assert module.__doc__, f"{name} has no docstring"
    monkeypatch.chdir(tmp_path)  # an example may write files
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=DOCTEST_FLAGS)
    for example in doctest.DocTestFinder(exclude_empty=True).find(module, name):
        runner.run(example, out=report.append)
    assert not runner.failures, "".join(report)


def test_a_wrong_example_is_noticed() -> None:
    test = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, 0)
    runner = doctest.DocTestRunner(optionflags=DOCTEST_FLAGS)
    runner.run(test, out=lambda line: None)
    assert runner.failures == 1


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_has_a_docstring_of_its_own(name: str) -> None:
    package = importlib.import_module(name)
    assert hasattr(package, "__all__"), f"{name} does not say in __all__ what is public"
    missing = []
    for public in package.__all__:
        value = getattr(package, public)  # raises for a name that does not exist
        if inspect.isclass(value):
            documented = bool((vars(value).get("__doc__") or "").strip())
        elif inspect.ismodule(value) or callable(value):
            documented = bool((getattr(value, "__doc__", None) or "").strip())
        else:  # a constant has the docstring of its type, which says nothing
            documented = True
        if not documented:
            missing.append(public)
    assert not missing, f"without a docstring in {name}: {missing}"


def test_public_names_are_exported_once() -> None:
    exported: Counter[str] = Counter()
    for name in PACKAGES:
        package = importlib.import_module(name)
        exported.update(
            public
            for public in getattr(package, "__all__", ())
            if not inspect.ismodule(getattr(package, public))
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
    "TreeView best_plans_below extract_plans OptionWorker TorchRLGymnasiumEnv "
    "free_tiles maze_from_text maze_to_text replay_recording shortest_path "
    "shortest_path_lengths Snapshot AttributeSnapshot ReplaySnapshot "
    "SnapshotError".split()
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
    if inspect.isclass(value) and "__init__" not in vars(value):
        if not dataclasses.is_dataclass(value):
            return list(getattr(value, "_fields", ()))  # else the base class tells
    taken = inspect.signature(constructor(value)).parameters.values()
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    skip = 1 if inspect.isclass(value) else 0
    return [
        p.name for p in list(taken)[skip:] if p.kind not in variable and not p.name.startswith("_")
    ]


def sentences_below_fields(value: Any) -> set[str]:
    """The fields of a dataclass that have a string below them."""
    from torchrl_hmcts.trainers.experiments.registry import field_docs

    return set(field_docs(value)) if dataclasses.is_dataclass(value) else set()


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
    if inspect.isclass(value):
        own = [vars(value).get("__init__"), vars(value).get("__post_init__")]
        functions = [inspect.unwrap(function) for function in own if inspect.isfunction(function)]
        functions = [f for f in functions if f.__code__.co_filename == inspect.getfile(value)]
    else:
        functions = [inspect.unwrap(value)]
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


@functools.cache
def methods(value: type) -> dict[str, Callable[..., Any]]:
    """The public methods and properties that a class of the project defines itself."""
    found = {}
    for name, method in vars(value).items():
        function = method.__func__ if isinstance(method, (classmethod, staticmethod)) else method
        function = function.fget if isinstance(function, property) else function
        if not name.startswith("_") and inspect.isfunction(function):
            if inspect.unwrap(function).__module__.startswith("torchrl_hmcts"):
                found[name] = function
    return found


def has_docstring(value: type, name: str) -> bool:
    """Whether a method has a docstring, its own or that of the method it overrides."""
    if methods(value)[name].__doc__:
        return True
    for base in value.__mro__[1:]:
        method = vars(base).get(name)
        if method is not None and base is not torch.nn.Module and method.__doc__:
            return True
    return False


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
        bare = [method for method in methods(value) if not has_docstring(value, method)]
        found.extend(f"a docstring of {method}" for method in bare)
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
