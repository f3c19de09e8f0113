"""The built wheel holds everything and works on its own, outside the repository."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Sequence
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
    found = [
        name.removesuffix("/__init__.py").replace("/", ".")
        for name in source_files()
        if name.endswith("/__init__.py")
    ]
    assert sorted(listed) == sorted(found)


def test_every_folder_with_a_module_is_a_package() -> None:
    folders = {path.parent for path in source_files().values() if path.suffix == ".py"}
    assert not [folder for folder in folders if not (folder / "__init__.py").is_file()]


def test_the_version_is_read_without_importing_the_package(wheel: Path) -> None:
    import torchrl_hmcts

    assert wheel.name == f"torchrl_hmcts-{torchrl_hmcts.__version__}-py3-none-any.whl"


def test_the_changelog_knows_the_version() -> None:
    import torchrl_hmcts

    changelog = (ROOT / "CHANGELOG.md").read_text()
    assert f"## [{torchrl_hmcts.__version__}]" in changelog


def test_the_wheel_holds_every_file_of_the_three_folders_and_no_other(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert names == set(source_files())
    assert "torchrl_hmcts/py.typed" in names


def test_the_wheel_stays_small(wheel: Path) -> None:
    assert wheel.stat().st_size < MAX_WHEEL_BYTES


def test_the_installed_package_is_not_the_repository(installed: Path) -> None:
    script = (
        "import json, torchrl_hmcts, torchrl_hmcts.envs, torchrl_hmcts.trainers\n"
        "parts = (torchrl_hmcts, torchrl_hmcts.envs, torchrl_hmcts.trainers)\n"
        "print(json.dumps([part.__file__ for part in parts]))"
    )
    done = run([installed / "bin" / "python", "-c", script], installed.parent)
    for name in json.loads(done.stdout.splitlines()[-1]):
        assert Path(name).resolve().is_relative_to(installed.resolve())


def test_no_global_package_called_envs_or_trainers_is_installed(installed: Path) -> None:
    (package,) = installed.glob("lib/python*/site-packages/torchrl_hmcts")
    assert not [name for name in ("envs", "trainers") if (package.parent / name).exists()]


def test_every_module_of_the_wheel_imports(installed: Path) -> None:
    names = [
        name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        for name in source_files()
        if name.endswith(".py") and not name.endswith("/__main__.py")
    ]
    script = f"import importlib\nfor name in {names}:\n    importlib.import_module(name)"
    run([installed / "bin" / "python", "-c", script], installed.parent)


@pytest.mark.parametrize("name", ["WaterworldMaze-v0", "GridworldMaze-v0"])
def test_gymnasium_makes_the_environments_by_name(installed: Path, name: str) -> None:
    script = (
        "import gymnasium\n"
        f"env = gymnasium.make('torchrl_hmcts.envs:torchrl_hmcts/{name}')\n"
        "observation, _ = env.reset(seed=0)\n"
        "assert observation in env.observation_space\n"
        "env.step(env.action_space.sample())"
    )
    run([installed / "bin" / "python", "-c", script], installed.parent)


def test_the_installed_demo_runs_at_toy_size(installed: Path, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    command = [installed / "bin" / "hmcts", "demo", "seed=0", f"out={out}", "toy=true"]
    run(command, tmp_path)
    metrics = json.loads((out / "metrics.json").read_text())
    assert "solved" in metrics
