"""Components know no environment, environments know no component, trainers know both."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = {
    "torchrl_hmcts": "torchrl_hmcts",
    "envs": "torchrl_hmcts.envs",
    "trainers": "torchrl_hmcts.trainers",
}
COMPONENT_DEPENDENCIES = {"torch", "tensordict", "torchrl", "numpy", "numba"}
# What a component may import inside a function, for those who have it.
OPTIONAL = {
    "torchrl_hmcts.planners.drawing": "matplotlib",
    "torchrl_hmcts.planners.export": "networkx",
}


def modules() -> dict[str, Path]:
    """Maps each module's import name to its file, over all three folders."""
    found = {}
    for folder, package in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            found[".".join((package, *parts))] = path
    return found


def outside_functions(tree: ast.AST) -> Iterator[ast.AST]:
    """Yields the nodes of a syntax tree that run when the module is imported."""
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            yield node
            yield from outside_functions(node)


def imported_names(
    source: str, module: str, *, is_package: bool, at_import: bool = False
) -> set[str]:
    """Returns the absolute name of everything a module's source imports, at any depth.

    ``from a import b`` counts as ``a`` and ``a.b``, since ``b`` may be a module. With
    ``at_import``, only what is imported along with the module, not by its functions.
    """
    package = module if is_package else module.rpartition(".")[0]
    names = set()
    tree = ast.parse(source)
    for node in outside_functions(tree) if at_import else ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")
                above = above[: len(above) - node.level + 1]
                base = ".".join([*above, base] if base else above)
            names.add(base)
            names.update(f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and node.args:
            called = node.func.attr if isinstance(node.func, ast.Attribute) else None
            called = node.func.id if isinstance(node.func, ast.Name) else called
            name = node.args[0]
            if (
                called in ("import_module", "__import__", "find_spec")
                and isinstance(name, ast.Constant)
                and isinstance(name.value, str)
            ):
                names.add(name.value)
    return names


def layer(name: str) -> str:
    """Returns ``envs``, ``trainers``, ``components``, ``base`` or ``outside`` for an import."""
    if name.split(".")[0] != "torchrl_hmcts":
        return "outside"
    if re.match(r"torchrl_hmcts\.(arguments|checks|compiling|processes)\b", name):  # for all
        return "base"
    second = [*name.split("."), ""][1]
    return second if second in ("envs", "trainers") else "components"


def violations(source: str, module: str, *, is_package: bool = False) -> list[str]:
    """Returns one sentence for each import that breaks the direction of the layers."""
    found = []
    names = imported_names(source, module, is_package=is_package)
    at_import = imported_names(source, module, is_package=is_package, at_import=True)
    own = layer(module)
    for name in sorted(names):
        other = layer(name)
        # `from torchrl_hmcts import envs` names the package on the way to `envs`; what it takes
        # from the package is checked under its own name.
        if name == "torchrl_hmcts" and any(n.startswith("torchrl_hmcts.") for n in names):
            continue
        if own == "components" and other in ("envs", "trainers"):
            found.append(f"component {module} imports {name} of the {other}")
        elif own == "envs" and other in ("components", "trainers"):
            found.append(f"environment {module} imports {name} of the {other}")
        elif own == "components" and other == "outside":
            top = name.split(".")[0]
            if top == OPTIONAL.get(module) and name not in at_import:
                continue
            if top not in COMPONENT_DEPENDENCIES and top not in sys.stdlib_module_names:
                found.append(
                    f"component {module} imports {name}; components import only "
                    f"{', '.join(sorted(COMPONENT_DEPENDENCIES))} and the standard library"
                )
    return found


def declared_distributions(*extras: str) -> set[str]:
    """Returns the normalised distribution names that pyproject.toml asks for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = list(project["dependencies"])
    for extra in extras:
        requirements += project["optional-dependencies"][extra]
    return {distribution_of(line) for line in requirements}


def distribution_of(requirement: str) -> str:
    return normalised(re.split(r"[\s\[<>=!~;]", requirement)[0])


def normalised(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()


@pytest.mark.parametrize("module", modules())
def test_a_module_imports_only_what_its_layer_may(module: str) -> None:
    path = modules()[module]
    assert not violations(path.read_text(), module, is_package=path.name == "__init__.py")


@pytest.mark.parametrize("module", modules())
def test_every_third_party_import_is_declared(module: str) -> None:
    path = modules()[module]
    extras = {"trainers": ("train", "atari", "scale", "wandb"), "envs": ("atari", "gym")}.get(
        layer(module), ()
    )
    if OPTIONAL.get(module) == "matplotlib":
        extras = ("train",)
    allowed = declared_distributions(*extras)
    if OPTIONAL.get(module) == "networkx":
        allowed |= {distribution_of(line) for line in importlib.metadata.requires("torch") or ()}
    provided_by = importlib.metadata.packages_distributions()
    names = imported_names(path.read_text(), module, is_package=path.name == "__init__.py")
    tops = {name.split(".")[0] for name in names} - sys.stdlib_module_names - {"torchrl_hmcts", ""}
    undeclared = {
        top: provided_by.get(top, ["no installed distribution"])
        for top in tops
        if not allowed & {normalised(d) for d in provided_by.get(top, [top])}
    }
    assert not undeclared, f"{module} imports what pyproject.toml does not name: {undeclared}"


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("torchrl_hmcts.planners.mcts", "import torchrl_hmcts.envs"),
        ("torchrl_hmcts.planners.mcts", "from torchrl_hmcts import envs"),
        ("torchrl_hmcts.planners.mcts", "from torchrl_hmcts.envs.mazes.layouts import maze_pool"),
        ("torchrl_hmcts.planners.mcts", "from ..envs import mazes"),
        ("torchrl_hmcts.planners.mcts", "from .. import trainers"),
        ("torchrl_hmcts.planners.mcts", "def f():\n    from torchrl_hmcts import trainers"),
        ("torchrl_hmcts.planners.mcts", "import_module('torchrl_hmcts.trainers.cli')"),
        ("torchrl_hmcts.planners.mcts", "import pymunk"),
        ("torchrl_hmcts.testing", "import matplotlib.pyplot as plt"),
        ("torchrl_hmcts.testing", "def f():\n    import matplotlib.pyplot as plt"),
        ("torchrl_hmcts.planners.tree", "def f():\n    import networkx"),
        ("torchrl_hmcts.planners.drawing", "from matplotlib import pyplot"),
        ("torchrl_hmcts.planners.drawing", "if True:\n    import matplotlib"),
        ("torchrl_hmcts.planners.drawing", "class A:\n    import matplotlib"),
        ("torchrl_hmcts.planners.drawing", "def f():\n    import networkx"),
        ("torchrl_hmcts.planners.export", "import networkx"),
        ("torchrl_hmcts.planners.export", "def f():\n    import matplotlib"),
        ("torchrl_hmcts.envs.mazes.layouts", "import torchrl_hmcts"),
        ("torchrl_hmcts.envs.mazes.layouts", "from torchrl_hmcts.planners import MCTSPlanner"),
        ("torchrl_hmcts.envs.mazes.layouts", "from torchrl_hmcts import planners"),
        ("torchrl_hmcts.envs.mazes.layouts", "from ... import testing"),
        (
            "torchrl_hmcts.envs.mazes.layouts",
            "import importlib\nimportlib.import_module('torchrl_hmcts.trainers')",
        ),
    ],
)
def test_the_check_catches_a_violation(module: str, source: str) -> None:
    assert violations(source, module)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        (
            "torchrl_hmcts.planners.mcts",
            "import math\nimport torch\nfrom torchrl.envs import EnvBase",
        ),
        ("torchrl_hmcts.planners.mcts", "from .tree import SearchTree\nfrom ..modules import x"),
        ("torchrl_hmcts.planners.mcts", "from torchrl_hmcts import planners"),
        ("torchrl_hmcts.planners.drawing", "def f():\n    from matplotlib import pyplot"),
        ("torchrl_hmcts.planners.export", "def f():\n    import networkx"),
        ("torchrl_hmcts.envs.mazes.layouts", "import pymunk\nfrom torchrl_hmcts.envs import mazes"),
        ("torchrl_hmcts.envs.mazes.layouts", "from . import rendering"),
        ("torchrl_hmcts.trainers.experiments.demo", "from torchrl_hmcts import envs, planners"),
    ],
)
def test_the_check_lets_the_right_direction_pass(module: str, source: str) -> None:
    assert not violations(source, module)


def test_a_package_resolves_its_relative_imports_from_itself() -> None:
    source = "from .tree import SearchTree"
    names = imported_names(source, "torchrl_hmcts.planners", is_package=True)
    assert "torchrl_hmcts.planners.tree" in names


def loaded_by(statement: str, folder: Path) -> set[str]:
    """Returns the names of all modules a fresh process holds after a statement."""
    script = f"import json, sys\n{statement}\nprint(json.dumps(sorted(sys.modules)))"
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    return set(json.loads(run.stdout.splitlines()[-1]))


def test_importing_the_components_loads_nothing_heavy_beyond_torchrl(tmp_path: Path) -> None:
    submodules = "collectors data envs modules objectives"
    baseline = loaded_by(
        "\n".join(f"import torchrl.{name}" for name in submodules.split()), tmp_path
    )
    packages = "modules objectives planners transforms"
    loaded = loaded_by(
        "import torchrl_hmcts\n"
        + "\n".join(f"import torchrl_hmcts.{name}" for name in packages.split()),
        tmp_path,
    )
    heavy = {
        *("numba", "llvmlite", "pymunk", "gymnasium", "ale_py", "matplotlib", "imageio", "PIL"),
        *("hydra", "omegaconf", "tensorboard", "tqdm", "networkx"),
    }
    assert not (heavy & loaded) - baseline
    assert not {name for name in loaded if layer(name) in ("envs", "trainers")}


def test_everything_that_benchmarks_import_from_the_project_exists() -> None:
    missing = []
    for path in sorted((ROOT / "tests" / "benchmarks").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchrl_hmcts"):
                module = importlib.import_module(node.module or "")
                names = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                missing += [f"{path.name}: {node.module}.{name}" for name in names]
    assert missing == []
