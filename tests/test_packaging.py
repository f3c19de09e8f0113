"""The built wheel holds everything, asks for all it imports, and works on its own."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
FOLDERS = {
    "torchrl_hmcts": "torchrl_hmcts",
    "envs": "torchrl_hmcts/envs",
    "trainers": "torchrl_hmcts/trainers",
}
MAX_WHEEL_BYTES = 1_000_000
EXTRAS = {
    "envs": ("atari", "gym"),
    "trainers": ("train", "atari", "gym", "scale", "wandb"),
    "torchrl_hmcts/notebook.py": ("train",),
    "torchrl_hmcts/planners/drawing.py": ("train",),
}


def source_files() -> dict[str, Path]:
    """Maps each file's path in the wheel to the file in the repository."""
    return {
        f"{target}/{path.relative_to(ROOT / folder).as_posix()}": path
        for folder, target in FOLDERS.items()
        for path in sorted((ROOT / folder).rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith(".")
    }


def run(
    command: Sequence[str | Path], folder: Path, *, timeout_seconds: float = 300
) -> subprocess.CompletedProcess[str]:
    """Runs a command with no trace of this process's Python settings and shows its output."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    env.update(PYTHONNOUSERSITE="1", PYTHONDONTWRITEBYTECODE="1", OMP_NUM_THREADS="1")
    done = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        env=env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout_seconds,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Builds the wheel from a copy, so that a left-over build/lib cannot get into it."""
    source = tmp_path_factory.mktemp("source")
    for folder in FOLDERS:
        shutil.copytree(
            ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__")
        )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", "dist", "."]
    run(command, source)
    (built,) = (source / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Installs the wheel in a fresh environment and returns the environment's folder.

    The dependencies come from the present environment by a line in a .pth file. Such a line adds a
    folder without running the .pth files in it, so an editable install there stays invisible.
    """
    folder = tmp_path_factory.mktemp("outside") / "venv"
    run([sys.executable, "-m", "venv", "--without-pip", folder], folder.parent)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--no-index", "--no-deps"]
    run([*pip, wheel], folder.parent)
    inner = "import sysconfig; print(sysconfig.get_paths()['purelib'])"
    site = Path(run([python, "-c", inner], folder.parent).stdout.strip())
    paths = sysconfig.get_paths()
    (site / "dependencies.pth").write_text(f"{paths['purelib']}\n{paths['platlib']}\n")
    return folder


def test_the_listed_packages_are_the_folders_with_an_init_file() -> None:
    listed = PYPROJECT["tool"]["setuptools"]["packages"]
    names = [name for name in source_files() if name.endswith("/__init__.py")]
    found = [name.removesuffix("/__init__.py").replace("/", ".") for name in names]
    assert sorted(listed) == sorted(found)
    folders = {path.parent for path in source_files().values() if path.suffix == ".py"}
    assert not [folder for folder in folders if not (folder / "__init__.py").is_file()]


def test_the_changelog_and_the_wheel_know_the_version(wheel: Path) -> None:
    import torchrl_hmcts

    version = torchrl_hmcts.__version__
    assert wheel.name == f"torchrl_hmcts-{version}-py3-none-any.whl"
    assert f"## [{version}]" in (ROOT / "CHANGELOG.md").read_text()


def test_the_wheel_holds_every_file_of_the_three_folders_and_no_other(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert names == set(source_files())
    assert "torchrl_hmcts/py.typed" in names
    assert wheel.stat().st_size < MAX_WHEEL_BYTES


def imports(path: Path) -> Iterator[str]:
    """Yield the packages that a file imports, at any depth."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield (node.module or "").split(".")[0]


def distributions(*requirements: str) -> set[str]:
    names = [re.split(r"[\s\[<>=!~;]", line)[0] for line in requirements]
    return {re.sub(r"[-_.]+", "-", name).lower() for name in names}


def test_every_third_party_import_is_declared() -> None:
    optional = PYPROJECT["project"]["optional-dependencies"]
    provided = importlib.metadata.packages_distributions()
    undeclared = {}
    for name, path in source_files().items():
        if path.suffix != ".py":
            continue
        extras = EXTRAS.get(name, EXTRAS.get(path.relative_to(ROOT).parts[0], ()))
        lines = [line for extra in extras for line in optional[extra]]
        allowed = distributions(*PYPROJECT["project"]["dependencies"], *lines)
        if name.endswith("planners/export.py"):  # a tree as a graph, for those who have networkx
            allowed |= distributions(*(importlib.metadata.requires("torch") or ()))
        tops = set(imports(path)) - sys.stdlib_module_names - {"torchrl_hmcts"}
        wrong = [t for t in tops if not allowed & distributions(*provided.get(t, [t]))]
        undeclared.update({name: wrong} if wrong else {})
    assert undeclared == {}


INSTALLED = """
import importlib, json, sys
for name in {names}:
    module = importlib.import_module(name)
    assert module.__file__.startswith({root}), module.__file__
import gymnasium
for maze in ("WaterworldMaze-v0", "GridworldMaze-v0"):
    env = gymnasium.make(f"torchrl_hmcts.envs:torchrl_hmcts/{maze}")
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    env.step(env.action_space.sample())
"""


def test_every_module_imports_from_the_wheel_and_gymnasium_knows_its_envs(installed: Path) -> None:
    names = [name for name in source_files() if name.endswith(".py")]
    names = [n.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for n in names]
    names = [name for name in names if not name.endswith(".__main__")]
    script = INSTALLED.replace("{names}", repr(names)).replace("{root}", repr(str(installed)))
    run([installed / "bin" / "python", "-c", script], installed.parent)
    (package,) = installed.glob("lib/python*/site-packages/torchrl_hmcts")
    assert not [name for name in ("envs", "trainers") if (package.parent / name).exists()]


def test_the_installed_demo_runs_at_toy_size(installed: Path, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    command = [installed / "bin" / "hmcts", "demo", "seed=0", f"out={out}", "toy=true"]
    run(command, tmp_path)
    assert "solved" in json.loads((out / "metrics.json").read_text())


def test_importing_the_components_loads_nothing_heavy_beyond_torchrl(tmp_path: Path) -> None:
    def loaded(package: str, parts: str) -> set[str]:
        lines = "\n".join(f"import {package}.{part}" for part in parts.split())
        script = f"import json, sys\n{lines}\nprint(json.dumps(sorted(sys.modules)))"
        words = [sys.executable, "-c", script]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        return set(json.loads(done.stdout.splitlines()[-1]))

    found = loaded("torchrl_hmcts", "modules objectives planners transforms")
    heavy = {
        *("numba", "llvmlite", "pymunk", "gymnasium", "ale_py", "matplotlib", "imageio", "PIL"),
        *("hydra", "omegaconf", "tensorboard", "tqdm", "networkx"),
        *("torchrl_hmcts.envs", "torchrl_hmcts.trainers"),
    }
    assert not (heavy & found) - loaded("torchrl", "collectors data envs modules objectives")


def test_everything_that_benchmarks_import_from_the_project_exists() -> None:
    missing = []
    for path in sorted((ROOT / "benchmarks").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            name = getattr(node, "module", None) or ""
            if isinstance(node, ast.ImportFrom) and name.startswith("torchrl_hmcts"):
                module = importlib.import_module(name)
                names = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                missing += [f"{path.name}: {name}.{wanted}" for wanted in names]
    assert missing == []
