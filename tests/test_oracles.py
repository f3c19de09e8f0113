"""What has to stay while the code moves: public names, the figures of runs, old run folders.

``python tests/test_oracles.py`` writes the figures that are expected; look at their difference
before you commit it, and say in the changelog why a figure changed.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import pytest

from torchrl_hmcts.trainers.saving.run_folder import read_run

HERE = Path(__file__).resolve().parent / "oracles"
PACKAGES = ("planners", "objectives", "modules", "transforms", "testing", "envs", "trainers")
HMCTS = (sys.executable, "-m", "torchrl_hmcts.trainers.cli")
RUNS = {
    "demo": ["demo"],
    "labmaze": ["train", "experiment=labmaze"],
    "waterworld_goals": ["train", "experiment=waterworld_goals"],
    "waterworld_a3c": ["train", "experiment=waterworld_a3c"],
    "atari": ["train", "experiment=atari", "game=Breakout"],
}


def public_names() -> dict[str, list[str]]:
    modules = {name: importlib.import_module(f"torchrl_hmcts.{name}") for name in PACKAGES}
    return {name: sorted(module.__all__) for name, module in modules.items()}


def toy_run(name: str, folder: Path) -> dict[str, Any]:
    """Runs an experiment at toy size; returns its figures and the last value of each curve."""
    words = [*RUNS[name], "toy=true", "seed=0", f"out={folder}"]
    subprocess.run([*HMCTS, *words], check=True, capture_output=True)
    run = read_run(folder)
    figures = {k: v for k, v in run.metrics.items() if "seconds" not in k}
    figures["test"] = {k: v for k, v in figures.get("test", {}).items() if "seconds" not in k}
    ends = {k: c.values[-1] for k, c in run.curves.items() if "second" not in k}
    return json.loads(json.dumps({"figures": figures, "ends_of_curves": ends}))


def expected(name: str) -> Any:
    return json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))


def assert_same(got: Any, right: Any, where: str) -> None:
    """Numbers may differ in the seventh digit: other processors sum in another order."""
    if isinstance(right, dict):
        assert sorted(got) == sorted(right), where
        for key in right:
            assert_same(got[key], right[key], f"{where}.{key}")
    elif isinstance(right, list):
        assert len(got) == len(right), where
        for i, pair in enumerate(zip(got, right, strict=True)):
            assert_same(*pair, f"{where}[{i}]")
    elif isinstance(right, float):
        assert got == pytest.approx(right, rel=1e-6, abs=1e-9), where
    else:
        assert got == right, where


def test_a_public_name_goes_only_with_a_line_in_the_changelog() -> None:
    changelog = (HERE.parent.parent / "CHANGELOG.md").read_text(encoding="utf-8")
    now = public_names()
    for package, names in expected("names").items():
        for name in set(names) - set(now[package]):
            assert f"`{name}`" in changelog, f"{package}.{name} is gone without a word"


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_a_toy_run_gives_the_figures_that_it_gave(name: str, tmp_path: Path) -> None:
    if name == "atari":
        pytest.importorskip("ale_py")
    assert_same(toy_run(name, tmp_path / "run"), expected("toy_runs")[name], name)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "figure"), [("demo", "solved"), ("atari", "score")])
def test_a_folder_of_an_older_version_is_evaluated(name: str, figure: str, tmp_path: Path) -> None:
    with tarfile.open(HERE / "runs.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    assert read_run(tmp_path / name).finished
    subprocess.run([*HMCTS, "evaluate", f"run={tmp_path / name}"], check=True, capture_output=True)
    (evaluation,) = read_run(tmp_path / name).evaluations
    assert figure in json.dumps(evaluation)


if __name__ == "__main__":
    import tempfile

    (HERE / "names.json").write_text(json.dumps(public_names(), indent=1) + "\n")
    with tempfile.TemporaryDirectory() as folder:
        runs = {name: toy_run(name, Path(folder, name)) for name in RUNS}
    (HERE / "toy_runs.json").write_text(json.dumps(runs, indent=1) + "\n")
