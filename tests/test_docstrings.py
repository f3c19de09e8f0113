"""The examples in the docstrings run, and everything public has one.

Modules are found and imported by name: by path, each class of a mapped folder would exist twice.
"""

from __future__ import annotations

import doctest
import importlib
import importlib.util
import inspect
import pkgutil
from collections import Counter
from pathlib import Path

import pytest

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
    if ".envs.atari_" in name:
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
