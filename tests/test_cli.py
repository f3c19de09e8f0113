"""The command line: experiments by name, their keys, and what it says when something is wrong."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

import torchrl_hmcts
from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments.registry import EXPERIMENTS, Experiment
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.runs import console
from torchrl_hmcts.trainers.runs.config import config_keys
from torchrl_hmcts.trainers.saving.run_folder import read_run

ALL = [*EXPERIMENTS.values()]


@pytest.mark.parametrize("experiment", ALL, ids=lambda e: e.name)
def test_every_key_of_an_experiment_has_a_default_and_a_sentence(experiment: Experiment) -> None:
    for name, (_, meaning) in config_keys(experiment.config_class).items():
        assert meaning.endswith("."), name
    assert experiment.config_class().out == f"runs/{experiment.name}"
    assert callable(experiment.function)


@pytest.mark.parametrize("words", [["list"], ["list", "experiments"]])
def test_the_list_names_every_experiment(capsys, words: list[str]) -> None:
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert all(f"  {name} " in printed for name in EXPERIMENTS)


def test_the_keys_of_an_experiment_are_listed_with_defaults_and_meaning(capsys) -> None:
    assert main(["list", "waterworld_goals"]) == 0
    printed = capsys.readouterr().out
    assert "  goal_met_threshold=0.5\n      Tiles within which a goal is met." in printed
    assert "  gamma=0.99\n      Discount per base step." in printed  # of the class it extends


@pytest.mark.parametrize("verb", [["list", "labmase"], ["train", "experiment=labmase"]])
def test_an_unknown_experiment_is_refused_with_the_nearest(capsys, verb: list[str]) -> None:
    assert main(verb) == 2
    assert "Did you mean: labmaze" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["seed=1"], "say which experiment, e.g. experiment=waterworld_goals"),
        ([], "say which experiment"),
        (["experiment=labmaze", "experiment=labmaze"], "experiment is given twice"),
        (["experiment="], "experiment= has no value"),
    ],
)
def test_train_wants_one_experiment(capsys, words: list[str], message: str) -> None:
    assert main(["train", *words]) == 2
    assert message in capsys.readouterr().err


def test_an_unknown_key_of_an_experiment_is_refused_with_the_nearest(capsys) -> None:
    assert main(["train", "experiment=waterworld_goals", "num_lerners=3"]) == 2
    error = capsys.readouterr().err
    assert "hmcts train experiment=waterworld_goals:" in error
    assert "Did you mean: num_learners" in error


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trian"], "Unknown verb 'trian'. Did you mean: train"),
        (["list", "gyn"], "Unknown experiment 'gyn'. Did you mean: gym"),
        (["train", "labmaze"], "Write experiment=labmaze"),
        (["train", "gym"], "Write kit=gym"),
        (["train", "labmase"], "Did you mean experiment=labmaze?"),
        (["train", "experiment=labmaze", "--seed", "1"], "without dashes: seed=1"),
        (["demo", "--num-skills=3"], "without dashes: num_skills=3"),
        (["sweep", "labmaze"], "Write experiment=labmaze"),
        (["evaluate", "."], "Write run=."),
        (["completion"], "hmcts completion bash"),
        (
            ["sweep", "experiment=labmaze", "seed=[0,1]", "objective=test.sloved"],
            "no figure 'test.sloved'. Did you mean: test.solved",
        ),
    ],
)
def test_a_slip_is_answered_by_the_right_words(capsys, words: list[str], message: str) -> None:
    assert main(words) == 2
    assert message in capsys.readouterr().err


def test_a_folder_that_is_refused_is_not_announced(tmp_path, capsys) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "run.json").write_text('{"experiment": "demo", "config": {"seed": 3}}')
    assert main(["demo", f"out={tmp_path}/one"]) == 1
    printed = capsys.readouterr()
    assert "starts" not in printed.out
    assert "holds a" in printed.err
    assert main(["evaluate", f"run={tmp_path}"]) == 2  # a folder of runs
    assert f"It holds the runs {tmp_path}/one." in capsys.readouterr().err


def test_the_version_is_said(capsys) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"hmcts {torchrl_hmcts.__version__}\n"


def test_the_first_words_come_before_torch_is_loaded(tmp_path) -> None:
    program = (
        "import sys\nfrom torchrl_hmcts.trainers import cli\n"
        "from torchrl_hmcts.trainers.command_line import running\n"
        "def stop(config, parts): sys.exit('torch' in sys.modules)\n"
        "running.with_parts = stop\n"
        f"words = ['experiment=labmaze', 'out={tmp_path}', 'logger=tensorboard']\n"
        "cli.main(['train', *words, 'planner/tree_policy=puct'])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.splitlines() == [
        "hmcts train experiment=labmaze starts, seed 0",
        f"  output  {tmp_path}",
        f"  watch   tensorboard --logdir {tmp_path}",
    ]


def test_tab_offers_verbs_experiments_and_keys(capsys) -> None:
    assert main(["completion", "words", "train", "experiment=lab"]) == 0
    assert "experiment=labmaze" in capsys.readouterr().out.split()
    assert main(["completion", "words", "demo", "s"]) == 0
    assert "seed=" in capsys.readouterr().out.split()
    assert main(["completion", "words", ""]) == 0
    assert {"train", "evaluate", "completion"} <= set(capsys.readouterr().out.split())


def test_bars_are_lines_without_a_terminal_and_never_show_nan(capsys, monkeypatch) -> None:
    monkeypatch.setattr(console, "INTERVAL", 0.0)
    with console.Bar(4, desc="learn", unit="frames", scale=4) as bar:
        bar.set_postfix(loss=float("nan"), accuracy="0.5", actor="nan")
        bar.update(2)
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("learn: 50 % (8 of 16 frames)")
    assert lines[-1].endswith("accuracy=0.5")
    assert max(map(len, lines)) < 80


def test_what_takes_long_gives_signs_of_life(capsys, monkeypatch) -> None:
    monkeypatch.setattr(console, "INTERVAL", 0.0)
    with console.alive():
        console.say("Compiling the search ...")
        time.sleep(1.3)
    assert "Compiling the search: 1 s so far" in capsys.readouterr().err


def test_ctrl_c_ends_with_the_command_that_continues(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)

    def interrupted(config) -> dict:
        raise KeyboardInterrupt

    monkeypatch.setattr("torchrl_hmcts.trainers.experiments.goals.run_goals", interrupted)
    assert main(["train", "experiment=waterworld_a3c", "out=runs/my own"]) == 130
    assert "Continue with: hmcts train 'resume=runs/my own'" in capsys.readouterr().err
    assert read_run("runs/my own").record["status"] == "stopped"


def test_the_demo_lists_its_keys_with_their_meaning(capsys) -> None:
    assert main(["demo", "--help"]) == 0
    assert f"  gamma={DemoConfig().gamma}\n      Discount per base step." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("message", "helps"),
    [
        ("[Errno 28] No space left on device: 'runs/a'", True),
        ("A3CTrainer cannot start: /dev/shm has 16,384 bytes: make room.", False),
        ("This process may open 64 files (`ulimit -n`): raise that.", False),
    ],
)
def test_another_folder_is_advised_only_where_it_helps(message: str, helps: bool) -> None:
    from torchrl_hmcts.trainers.command_line.running import with_advice

    advised = with_advice(message, "hmcts train resume=runs/a")
    advice = "Continue with: hmcts train resume=runs/a, or choose another folder with out=DIR."
    assert advised.endswith(advice) == helps
    assert ".." not in advised
