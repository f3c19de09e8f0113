"""The wheel on several Pythons: builds it once, installs it alone in each, runs tests against it.

    python benchmarks/pythons.py python3.10 python3.12 python3.13
    python benchmarks/pythons.py python3.13 --tests test_planner.py test_cli.py

The arguments are interpreters. Each gets a fresh environment with the wheel and its extras `train`
and `dev`, resolved as for any user (some gigabytes each, deleted again), and a
copy of the tests outside the checkout, so that what they import is the installed wheel.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from reliability import run_pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("torch", "torchrl", "tensordict", "numpy", "numba", "gymnasium", "pymunk", "ale-py")

# One file at least of each part: planners, transforms, losses, modules, envs, trainers, command
# line. Those that read the checkout (pages, wheel, layering) or take minutes are left out.
TESTS = [
    f"test_{name}.py"
    for name in """
    planner planner_golden array_search tree_policies evaluators novelty search_data
    option_transform skill_transforms subgoal_transform contract_transforms contract_losses
    contract_envs a3c_loss diayn_loss skill_objectives smdp_estimators modules termination
    option_model waterworld gridworld mazes gym_envs lab_recordings atari_ram atari_pool docstrings
    testing_checks configs cli sweep demo trainer_resume fault_checkpoints hierarchical_policy
    animation
    """.split()
]

PROBE = """
import importlib.metadata, json, platform, torchrl_hmcts, torchrl_hmcts.envs, torchrl_hmcts.trainers
parts = (torchrl_hmcts, torchrl_hmcts.envs, torchrl_hmcts.trainers)
print(json.dumps({
    "python": platform.python_version(),
    **{name: importlib.metadata.version(name) for name in %r},
    "files": [part.__file__ for part in parts],
}))
"""


def build_wheel(folder: Path) -> Path:
    """Build the wheel from what is committed, unpacked into ``folder / "source"``; return it."""
    source, dist = folder / "source", folder / "dist"
    for old in (source, dist):
        shutil.rmtree(old, ignore_errors=True)
    source.mkdir(parents=True)
    archive = subprocess.check_output(["git", "archive", "HEAD"], cwd=ROOT)
    subprocess.run(["tar", "-x"], cwd=source, input=archive, check=True)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(dist)]
    subprocess.run([*command, "."], cwd=source, check=True, stdout=subprocess.DEVNULL)
    (wheel,) = dist.glob("*.whl")
    return wheel


def install(interpreter: str, wheel: Path, environment: Path) -> None:
    """Install the wheel with its extras in a fresh environment, or again in one that is there."""
    pip = [str(environment / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    if environment.exists():
        subprocess.run([*pip, "--force-reinstall", "--no-deps", str(wheel)], check=True)
    else:
        subprocess.run([interpreter, "-m", "venv", str(environment)], check=True)
    subprocess.run([*pip, f"{wheel}[train,dev]"], check=True)


def run_tests(environment: Path, source: Path, folder: Path, tests: list[str]) -> dict[str, Any]:
    """Run tests against the installed wheel, outside the checkout; return counts and versions."""
    python = str(environment / "bin" / "python")
    shutil.rmtree(folder, ignore_errors=True)
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(source / "tests", folder / "tests", ignore=ignore)
    shutil.copy(source / "pyproject.toml", folder)
    settings = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    settings["PYTHONNOUSERSITE"] = "1"
    probe = [python, "-c", PROBE % (PACKAGES,)]
    printed = subprocess.check_output(probe, cwd=folder, env=settings)
    found = json.loads(printed.splitlines()[-1])
    for name in found.pop("files"):
        if environment.resolve() not in Path(name).resolve().parents:
            raise RuntimeError(f"{name} would be tested instead of the wheel in {environment}.")

    counts = run_pytest(
        *(f"tests/{name}" for name in tests), python=python, cwd=folder, env=settings
    )
    return {**found, "test_files": len(tests), **counts}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("interpreters", nargs="+", help="Pythons to test with, by name or path")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="files of tests/")
    parser.add_argument(
        "--folder",
        type=Path,
        help="where environments stay, and are used again; else all is temporary",
    )
    parser.add_argument("--out", type=Path, help="a JSON file, to which the counts are added")
    args = parser.parse_args()

    with tempfile.TemporaryDirectory() as temporary:
        folder = (args.folder or Path(temporary)).resolve()
        wheel = build_wheel(folder)
        for interpreter in args.interpreters:
            version = "import sys; print('%d.%d' % sys.version_info[:2])"
            name = subprocess.check_output([interpreter, "-c", version], text=True).strip()
            environment = folder / f"py{name}"
            install(interpreter, wheel, environment)
            found = run_tests(environment, folder / "source", folder / f"run{name}", args.tests)
            if args.folder is None:
                shutil.rmtree(environment)
            print(json.dumps({name: found}, indent=1), flush=True)
            if args.out is not None:
                add(args.out, name, {**found, "wheel_bytes": wheel.stat().st_size})


def add(out: Path, name: str, found: dict[str, Any]) -> None:
    """Write what was found with one Python into the file, beside the others."""
    pythons = json.loads(out.read_text())["pythons"] if out.exists() else {}
    pythons[name] = found
    names = sorted(pythons, key=lambda version: int(version.partition(".")[2]))
    command = f"python benchmarks/pythons.py {' '.join(f'python{name}' for name in names)}"
    figures = {"command": command, "pythons": {name: pythons[name] for name in names}}
    out.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
