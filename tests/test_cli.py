"""The command line: experiments by name, their keys, and what it says when something is wrong."""

from __future__ import annotations

import pytest

from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments import EXPERIMENTS, Experiment
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
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


def test_ctrl_c_ends_with_the_command_that_continues(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)

    def interrupted(config) -> dict:
        raise KeyboardInterrupt

    monkeypatch.setattr("torchrl_hmcts.trainers.experiments.goals.run_goals", interrupted)
    assert main(["train", "experiment=waterworld_a3c", "out=runs/my own"]) == 130
    assert "Continue with: hmcts train 'resume=runs/my own'" in capsys.readouterr().err
    assert read_run("runs/my own").record["status"] == "stopped"


def test_the_demo_lists_its_keys_with_their_meaning(capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["demo", "--help"])
    assert stop.value.code == 0
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
