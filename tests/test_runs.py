"""Runs and their folders: nothing is lost, and what is said about them is true.

Most tests run an experiment without any training, in this process.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig
from torchrl_hmcts.trainers.experiments.settings import (
    DemoConfig,
    LabMazeConfig,
    WaterworldGoalsConfig,
)
from torchrl_hmcts.trainers.runs.config import RunConfig, home, parse_overrides
from torchrl_hmcts.trainers.runs.run import open_run
from torchrl_hmcts.trainers.saving.locking import FolderInUse, folder_locked, is_locked
from torchrl_hmcts.trainers.saving.run_folder import read_run

CONFIGS = (DemoConfig, LabMazeConfig, WaterworldGoalsConfig, AtariConfig)
DEMO = "torchrl_hmcts.trainers.experiments.skills.run_skills"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[DemoConfig]:
    """Runs of the demo, without any training: their configurations."""
    found: list[DemoConfig] = []

    def run_demo(config: DemoConfig) -> dict[str, Any]:
        with open_run(config) as run:
            found.append(run.config)
            run.checkpoints.mkdir(exist_ok=True)
            (run.checkpoints / "checkpoint-000000000064.torchrl").write_text(str(config.seed))
            with run.finish({"seed": config.seed, "solved": 1}, title="A demo"):
                pass
        return {}

    monkeypatch.setattr(DEMO, run_demo)
    return found


def written(folder: str | Path) -> dict[str, bytes]:
    """Every file below a folder, with its content."""
    return {
        str(p.relative_to(folder)): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()
    }


class TestFolders:
    def test_two_runs_at_their_defaults_go_into_two_folders(self, ran, capsys) -> None:
        assert main(["demo"]) == main(["demo", "seed=1"]) == main(["demo", "toy=true"]) == 0
        assert [config.out for config in ran] == ["runs/demo", "runs/demo_2", "runs/demo_toy"]
        assert (
            "runs/demo holds a run already; this one goes to runs/demo_2" in capsys.readouterr().out
        )

    def test_a_folder_with_a_run_is_refused_with_what_to_type(self, ran, capsys) -> None:
        assert main(["demo", "out=a b", "seed=3"]) == 0
        before = written("a b")
        assert main(["demo", "out=a b", "toy=true"]) == 1
        said = capsys.readouterr().err
        for words in (
            "a b holds a finished run of demo, seed 3",
            "hmcts train 'resume=a b'",
            "overwrite=true",
            "'out=a b_2'",
        ):
            assert words in said
        assert written("a b") == before
        assert len(ran) == 1

    @pytest.mark.parametrize(
        "name",
        ["metrics.json", "index.html", "losses.png", "log/x.csv", "checkpoints/x", "sweep.json"],
    )
    def test_files_that_a_run_would_replace_are_refused_even_with_overwrite(
        self, ran, capsys, name: str
    ) -> None:
        mine = Path("mine", name)
        mine.parent.mkdir(parents=True)
        mine.write_text("{" if name == "metrics.json" else "my own")
        before = written("mine")
        assert main(["demo", "out=mine"]) == main(["demo", "out=mine", "overwrite=true"]) == 1
        assert f"({Path(name).parts[0]}), which would be lost" in capsys.readouterr().err
        assert written("mine") == before

    def test_other_files_in_the_folder_stay(self, ran) -> None:
        for name in ("notes.txt", "checkpoints/mine.txt"):
            Path("run", name).parent.mkdir(exist_ok=True, parents=True)
        Path("run/checkpoints").rmdir()
        Path("run/notes.txt").write_text("mine")
        assert main(["demo", "out=run"]) == 0
        Path("run/checkpoints/mine.txt").write_text("mine")
        Path("run/checkpoints/checkpoint-000000000099.torchrl").write_text("old")
        assert main(["demo", "out=run", "seed=5", "overwrite=true"]) == 0
        assert read_run("run").seed == 5
        assert Path("run/notes.txt").read_text() == Path("run/checkpoints/mine.txt").read_text()
        assert not Path("run/checkpoints/checkpoint-000000000099.torchrl").exists()
        assert read_run("run").config["overwrite"] is False  # it is no key of the run

    def test_out_that_is_a_file_is_refused(self, ran, capsys) -> None:
        Path("file").write_text("mine")
        assert main(["demo", "out=file", "overwrite=true"]) == 1
        assert "out=file is a file" in capsys.readouterr().err
        assert Path("file").read_text() == "mine"

    @pytest.mark.parametrize(
        ("words", "package"),
        [
            (["demo", "logger=wandb"], "wandb"),
            (["train", "experiment=labmaze", "logger=tensorboard"], "tensorboard"),
            (["train", "experiment=labmaze", "collector=ray"], "ray"),
            (["train", "experiment=atari", "tune_with=optuna"], "optuna"),
        ],
    )
    def test_a_missing_package_is_noticed_before_anything_is_touched(
        self, ran, monkeypatch, capsys, words: list[str], package: str
    ) -> None:
        pytest.importorskip("ale_py")
        monkeypatch.setitem(sys.modules, package, None)
        assert main(["demo", "out=run"]) == 0
        before = written("run")
        assert main([*words, "out=run", "overwrite=true"]) == 1
        assert f"hmcts needs {package}, which is not installed" in capsys.readouterr().err
        assert written("run") == before

    @pytest.mark.parametrize(
        ("word", "message"),
        [
            ("game=Nothing", "Nothing"),
            ("options_from=nowhere", "options_from=nowhere is not a run"),
        ],
    )
    def test_missing_inputs_are_noticed_before_anything_is_touched(
        self, capsys, word: str, message: str
    ) -> None:
        pytest.importorskip("ale_py")
        assert main(["train", "experiment=atari", word, "out=run"]) == 1
        assert message in capsys.readouterr().err
        assert not Path("run").exists()


class TestResuming:
    def test_the_saved_keys_are_those_of_the_first_command(self, ran) -> None:
        assert main(["demo", "mazes=20", "train_base_steps=20032", "out=run"]) == 0
        assert main(["train", "resume=run"]) == 0
        assert ran[1] == DemoConfig(mazes=20, train_base_steps=20_032, out="run", resume=True)
        assert main(["demo", "mazes=20", "out=run", "resume=true"]) == 0  # not the saved ones
        assert (ran[2].train_base_steps, ran[2].resume) == (40_000, True)
        assert len(read_run("run").record["commands"]) == 3

    def test_other_settings_are_refused_before_anything_is_touched(self, ran, capsys) -> None:
        assert main(["demo", "out=run"]) == 0
        before = written("run")
        assert main(["demo", "out=run", "resume=true", "num_skills=3"]) == 1
        assert "num_skills was 4 and is 3 here" in capsys.readouterr().err
        assert main(["train", "experiment=labmaze", "out=run", "resume=true"]) == 1
        assert "run holds a run of demo, not of labmaze" in capsys.readouterr().err
        assert main(["demo", "out=run", "resume=true", "overwrite=true"]) == 1
        assert written("run") == before

    def test_without_a_run_or_its_checkpoint_there_is_nothing_to_resume(self, ran, capsys) -> None:
        assert main(["demo", "out=none", "resume=true"]) == 1
        assert "There is no checkpoint in 'none'" in capsys.readouterr().err
        assert not Path("none").exists()
        assert main(["demo", "out=run"]) == 0
        Path("run/checkpoints/checkpoint-000000000064.torchrl").unlink()
        before = written("run")
        assert main(["train", "resume=run"]) == 1  # it would replace the figures of a finished run
        assert "There is no checkpoint in 'run/checkpoints'" in capsys.readouterr().err
        assert written("run") == before

    def test_a_run_killed_before_its_first_checkpoint_begins_again(self, ran, capsys) -> None:
        with pytest.raises(ZeroDivisionError), open_run(DemoConfig(out="run", mazes=7)):
            raise ZeroDivisionError
        assert main(["train", "resume=run"]) == 0
        assert "it begins again" in capsys.readouterr().out
        assert ran[0].mazes == 7

    def test_a_folder_named_like_a_truth_value_can_be_resumed(
        self, ran, monkeypatch, capsys
    ) -> None:
        assert main(["demo", "out=true"]) == 0
        assert main(["demo", "out=true"]) == 1
        assert "hmcts train resume=./true;" in capsys.readouterr().err
        assert main(["train", "resume=./true"]) == 0


class TestWords:
    @pytest.mark.parametrize(
        "out",
        [
            "007", "2024_01", "1e5", "null", "true", "[a]", "{a: b}", "a #2", "a: b", " a ", "'a'",
            "${oc.env:HOME}", "${seed}", "???", "a=b", "ünï", "a\nb", "-", "*", "!x",
        ],
    )  # fmt: skip
    @pytest.mark.parametrize("config", CONFIGS)
    def test_a_path_is_taken_letter_by_letter(self, config: type, out: str) -> None:
        assert parse_overrides(config, [f"out={out}"]).out == out

    @pytest.mark.parametrize("config", CONFIGS)
    def test_the_home_folder_is_expanded_once_and_everywhere(self, config: type, tmp_path) -> None:
        expanded = str(tmp_path / "home" / "x")
        assert config(out="~/x").out == parse_overrides(config, ["out=~/x"]).out == expanded
        assert config(out=Path("~/x")).out == expanded
        assert config(out="a/~/x").out == "a/~/x"
        assert home(expanded) == expanded

    def test_a_path_that_can_be_no_path_is_refused(self) -> None:
        for out in ("", "a\0b"):
            with pytest.raises(ValueError, match="out "):
                RunConfig(out=out)

    @pytest.mark.parametrize(
        ("word", "value"),
        [
            ("seed=1_000", 1000), ("seed=1e3", 1000), ("seed=1000.0", 1000),
            ("seed=4294967295", 2**32 - 1),
            ("gamma=1e-1", 0.1), ("gamma=1", 1.0), ("toy=yes", True), ("toy=False", False),
        ],
    )  # fmt: skip
    @pytest.mark.parametrize("config", CONFIGS)
    def test_numbers_as_people_write_them(self, config: type, word: str, value: Any) -> None:
        made = getattr(parse_overrides(config, [word]), word.partition("=")[0])
        assert made == value
        assert type(made) is type(value)

    @pytest.mark.parametrize(
        "word",
        [
            "seed=-1", "seed=99999999999999999999", "seed=1e20", "seed=1.5", "seed=true", "seed=",
            "seed=nan", "seed=inf", "seed=0x10", "seed=null", "gamma=nan", "gamma=inf",
            "gamma=-0.1", "num_skills=-3", "num_skills=0", "toy=2", "toy=",
        ],
    )  # fmt: skip
    @pytest.mark.parametrize("config", CONFIGS)
    def test_numbers_out_of_range_are_one_line_that_names_the_key(
        self, config: type, word: str, capsys
    ) -> None:
        if config is WaterworldGoalsConfig:
            word = word.replace("num_skills", "num_goals")
        if config is AtariConfig and word == "num_skills=0":  # the grid of Table 5.1
            word = "episodes=0"
        names = dict(zip(CONFIGS, ("demo", "labmaze", "waterworld_goals", "atari"), strict=True))
        command = ["demo"] if config is DemoConfig else ["train", f"experiment={names[config]}"]
        assert main([*command, word, "out=run"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f" {word.partition('=')[0]}" in line
        assert not Path("run").exists()

    def test_numpy_numbers_are_numbers(self) -> None:
        config = DemoConfig(seed=np.int64(3), gamma=np.float32(0.5), toy=np.bool_(True))
        assert config == DemoConfig(seed=3, gamma=0.5, toy=True)
        assert json.dumps(vars(config))
        for wrong in (np.array([1, 2]), 1.5, "1", None, True):
            with pytest.raises(TypeError, match="seed"):
                DemoConfig(seed=wrong)


class TestLocks:
    def test_a_second_run_in_the_folder_is_refused_while_the_first_runs(self, capsys, ran) -> None:
        with open_run(DemoConfig(out="run")):
            for words in (["demo", "out=run"], ["demo", "out=run", "overwrite=true"]):
                assert main(words) == 1
            with pytest.raises(FolderInUse, match=f"run is in use: process {os.getpid()}, since"):
                taken("run")
        taken("run")

    def test_a_resume_beside_the_run_that_still_runs_is_refused(self, capsys, ran) -> None:
        with other_process("open_run(DemoConfig(out='run', mazes=7))", "run/run.json"):
            assert read_run("run").status == "running"
            Path("run/checkpoints").mkdir()
            Path("run/checkpoints/checkpoint-000000000064.torchrl").write_text("")
            assert main(["train", "resume=run"]) == 1
            assert "run is in use: process" in capsys.readouterr().err
        assert read_run("run").status == "interrupted"  # killed: nobody could note it
        assert main(["train", "resume=run"]) == 0

    def test_a_default_folder_in_use_is_passed_over(self, ran) -> None:
        with other_process("open_run(DemoConfig())", "runs/demo/run.json"):
            assert main(["demo"]) == 0
        assert ran[0].out == "runs/demo_2"

    def test_a_child_that_outlives_the_run_does_not_keep_the_folder(self, tmp_path) -> None:
        with folder_locked(tmp_path):
            child = os.fork()
            if child == 0:
                signal.pause()
                os._exit(0)
        try:
            assert not is_locked(tmp_path)
            taken(tmp_path)
        finally:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)

    def test_where_files_cannot_be_locked_a_line_says_so(
        self, tmp_path, monkeypatch, capsys
    ) -> None:
        def no_locks(handle: int, how: int) -> None:
            raise OSError(37, "No locks available")

        monkeypatch.setattr("fcntl.flock", no_locks)
        taken(tmp_path)
        assert "cannot be locked ([Errno 37] No locks available)" in capsys.readouterr().err


def taken(folder: str | Path) -> None:
    with folder_locked(folder):
        pass


def other_process(opened: str, until: str) -> Any:
    """A process that opens a run and is killed at the end of the context."""
    code = (
        "import time\n"
        "from torchrl_hmcts.trainers.experiments.settings import DemoConfig\n"
        "from torchrl_hmcts.trainers.runs.run import open_run\n"
        f"with {opened}: time.sleep(100)"
    )

    @contextlib.contextmanager
    def running() -> Iterator[None]:
        process = subprocess.Popen([sys.executable, "-c", code])
        try:
            while not Path(until).is_file():
                assert process.poll() is None
                time.sleep(0.05)
            yield
        finally:
            process.kill()
            process.wait()

    return running()
