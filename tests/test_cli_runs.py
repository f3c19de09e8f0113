"""Runs from the command line at toy size: what they leave, going on with them, testing again."""

from __future__ import annotations

import csv
import errno
import json
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from torchrl.record.loggers import Logger

from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.runs.loggers import ScalarLoggers
from torchrl_hmcts.trainers.saving.run_folder import read_run

TRAIN = ["train", "experiment=waterworld_a3c", "toy=true", "seed=3"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "one"
    assert main([*TRAIN, f"out={out}"]) == 0
    return out


def test_a_run_records_experiment_config_command_versions_and_machine(run: Path) -> None:
    record = json.loads((run / "run.json").read_text())
    assert record["experiment"] == "waterworld_a3c"
    assert record["config"]["seed"] == 3
    assert record["commands"] == ["hmcts " + " ".join([*TRAIN, "out=one"])]
    assert record["status"] == "finished"
    assert set(record["machine"]) == {"cpus", "platform"}
    assert "torchrl" in record["versions"]
    assert str(run.parent) not in (run / "run.json").read_text()


def test_values_are_logged_as_csv_while_it_trains(run: Path) -> None:
    with (run / "log" / "scalars" / "eval_solved_share.csv").open() as file:
        logged = [(int(step), float(value)) for step, value in csv.reader(file)]
    curve = read_run(run).curves["eval_solved_share"]
    assert [step for step, _ in logged] == curve.steps
    np.testing.assert_allclose([value for _, value in logged], curve.values)


def test_a_run_is_tested_again_with_other_starts(run: Path, capsys) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    assert main(["evaluate", f"run={run}"]) == 0
    assert main(["evaluate", f"run={run}", "seed=4"]) == 0
    assert main(["evaluate", f"run={run}", "seed=4"]) == 0  # the same once more: in its place
    said = capsys.readouterr().out
    assert "evaluation.json" in said
    assert "  test: mazes  " in said  # a table, not JSON
    assert "{" not in said
    same, other = json.loads((run / "evaluation.json").read_text())["evaluations"]
    assert same["changes"] == {}
    assert same["results"]["test"].items() <= metrics["test"].items()  # the very same episodes
    assert same["results"]["test_greedy"] == metrics["test_greedy"]
    assert other["changes"] == {"seed": 4}
    assert other["results"]["checkpoint"] == same["results"]["checkpoint"]
    page = (run / "index.html").read_text()
    assert "Evaluated again" in page
    assert "<h3>seed=4</h3>" in page


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "say which run"),
        (["run={run}", "sed=1"], "Did you mean: seed"),
        (["run={run}", "out=elsewhere"], "Leave out= away"),
        (["run={run}/checkpoints"], "no folder of a run"),
        (["run={run}", "hidden=7"], "not those of this configuration"),
    ],
)
def test_what_evaluate_cannot_do_is_said(run: Path, capsys, words, message) -> None:
    assert main(["evaluate", *(word.format(run=run) for word in words)]) == 2
    assert message in capsys.readouterr().err


def test_damaged_checkpoints_are_a_sentence_in_every_command(run: Path, tmp_path, capsys) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    for path in [*copy.glob("checkpoints/*.torchrl"), *copy.glob("worker/*.torchrl")]:
        path.write_bytes(path.read_bytes()[:-1])
    for words in (["evaluate", f"run={copy}"], ["train", f"resume={copy}"]):
        assert main(words) == 1
        assert "No checkpoint in" in capsys.readouterr().err.splitlines()[-1]


def test_on_a_full_disk_an_evaluation_is_printed(run: Path, tmp_path, monkeypatch, capsys) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    monkeypatch.setattr("torchrl_hmcts.trainers.saving.files.os.replace", full)
    assert main(["evaluate", f"run={copy}"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out[said.out.index("{") :])["test"]
    assert [line.partition(":")[0] for line in said.err.splitlines()] == [
        "Left out evaluation.json",
        "Left out index.html",
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["resume={run}", "seed=1"], "'seed=1' would change it"),
        (["resume={run}", "experiment=labmaze"], "leave experiment=labmaze out"),
        (["resume={run}/nowhere"], "no folder of a run"),
    ],
)
def test_what_cannot_be_gone_on_with_is_said(run: Path, capsys, words, message) -> None:
    assert main(["train", *(word.format(run=run) for word in words)]) == 2
    assert message in capsys.readouterr().err


def test_log_level_warning_is_silent_on_standard_output(tmp_path, monkeypatch, capsys) -> None:
    def talks(config) -> dict:
        print("talking")
        return {}

    monkeypatch.setattr("torchrl_hmcts.trainers.experiments.skills.run_skills", talks)
    words = ["train", "experiment=labmaze", f"out={tmp_path}"]
    assert main(words) == 0
    assert "talking" in capsys.readouterr().out
    assert main([*words, "overwrite=true", "log_level=warning"]) == 0
    assert capsys.readouterr().out == ""
    assert main([*words, "log_level=loud"]) == 2
    assert "log_level is one of debug, info, warning, error; got 'loud'" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["demo", "train", "evaluate", "report", "sweep"])
def test_help_says_what_a_verb_needs_and_where_results_go(capsys, verb) -> None:
    assert main([verb, "--help"]) == 0
    printed = capsys.readouterr().out
    for word in ("\nneeds ", "\nwrites ", "log_level="):
        assert word in printed


def board(folder: Path, last: bytes) -> bytes:
    """The bytes that a board shows; W&B's own process may write them a moment later."""
    for _ in range(100):
        files = [*folder.rglob("events.out*"), *folder.rglob("*.wandb")]
        content = b"".join(file.read_bytes() for file in files if not file.is_symlink())
        if last in content:
            break
        time.sleep(0.1)
    return content


@pytest.mark.parametrize("logger", ["tensorboard", "wandb"])
def test_values_go_to_other_loggers_as_well(tmp_path, logger) -> None:
    pytest.importorskip(logger)
    from torchrl_hmcts.trainers.experiments.settings import DemoConfig
    from torchrl_hmcts.trainers.runs.loggers import make_logger

    made = make_logger(DemoConfig(out=str(tmp_path), logger=logger))
    made.log_scalar("entropy", 1.25, step=64)
    made.log_scalar("entropy", float("nan"), step=128)
    Figure().savefig(tmp_path / "search.png")
    made.log_pictures(tmp_path, {"search.png": "The search."})
    made.close()
    assert (tmp_path / "log" / "scalars" / "entropy.csv").read_text() == "64,1.25\n"
    content = board(tmp_path / logger, b"pictures/search")
    assert b"train/entropy" in content
    assert b"pictures/search" in content


@pytest.mark.parametrize("logger", ["tensorboard", "wandb"])
def test_a_board_gets_groups_and_what_the_page_shows(tmp_path, capsys, logger, monkeypatch) -> None:
    pytest.importorskip(logger)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    words = ["kit=waterworld", "toy=true", "mazes=1", f"logger={logger}", f"out={tmp_path}"]
    words += ["curve_points=1", "curve_mazes=1", "expansions=60"]
    assert main(["train", *words]) == 0
    watch = {
        "tensorboard": f"tensorboard --logdir {tmp_path}\n",
        "wandb": f"W&B is offline: afterwards wandb sync {tmp_path}/wandb/offline-run-*\n",
    }
    assert f"  watch   {watch[logger]}" in capsys.readouterr().out
    content = board(tmp_path / logger, b"pictures/losses")
    for tag in (b"loss/actor_loss", b"train/entropy", b"eval/solved"):
        assert tag in content
    shown = json.loads((tmp_path / "page.json").read_text())["pictures"]
    assert {"episode.gif", "search.png", "skills.png", "losses.png"} <= set(shown)
    for name in shown:
        assert f"pictures/{name.partition('.')[0]}".encode() in content
    films = list((tmp_path / logger).rglob("*.gif"))
    assert films if logger == "wandb" else b"GIF89a" in content


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("loss_actor", "loss/loss_actor"),
        ("critic_1_loss", "loss/critic_1_loss"),
        ("eval_solved_share", "eval/solved_share"),
        ("test_frames", "eval/frames"),
        ("entropy", "train/entropy"),
    ],
)
def test_names_are_in_groups_where_a_page_shows_groups(name: str, shown: str) -> None:
    class Board(Logger):
        def __init__(self) -> None:
            self.names: list[str] = []

        def log_scalar(self, name, value, step=None) -> None:
            self.names.append(name)

        _create_experiment = log_video = log_hparams = log_histogram = __repr__ = None

    board = Board()
    ScalarLoggers([board]).log_scalar(name, 1.0, step=0)
    assert board.names == [shown]
