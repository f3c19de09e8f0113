"""The agent over a kit from the command line: other parts, combinations, given options."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from tensordict.nn import TensorDictModule

from torchrl_hmcts.planners import PUCT, UCT, MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.command_line import train
from torchrl_hmcts.trainers.command_line.words import parse_config
from torchrl_hmcts.trainers.experiments.gym_settings import GymConfig
from torchrl_hmcts.trainers.experiments.kits import make_kit
from torchrl_hmcts.trainers.experiments.registry import DEMO
from torchrl_hmcts.trainers.experiments.settings import DemoConfig, LabMazeConfig
from torchrl_hmcts.trainers.saving.run_folder import read_run

PARTS = ["objective=metra", "planner/tree_policy=puct", "planner/novelty=radius"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("kits") / "run"
    words = ["kit=waterworld", *PARTS, "planner.novelty.radius=0.5", "toy=true", f"out={out}"]
    assert main(["train", *words]) == 0
    return out


class Nothing:
    """A figure of nothing, at any depth."""

    def __getitem__(self, key: str) -> Nothing:
        return self

    def __format__(self, spec: str) -> str:
        return format(float("nan"), spec.replace(",", ""))


@pytest.mark.parametrize("config", [DemoConfig(), LabMazeConfig(), GymConfig(id="MountainCar-v0")])
def test_the_table_that_ends_a_run_fits_80_columns_and_shows_no_nan(config) -> None:
    kit = make_kit(config)
    names = re.findall(r"\{(\w+)", " ".join(form for _, form in kit.rows()))
    lines = kit.table({name: Nothing() for name in names}).splitlines()
    assert len(lines) == len(kit.rows()) >= 7
    assert all(len(line) < 80 and line.endswith(" -") for line in lines)
    assert "solved" in lines[0]


def test_a_composed_agent_is_noted_and_continued(run: Path) -> None:
    saved = read_run(run).config
    assert saved["objective"]["_component_"].endswith("METRAEncoderLoss")
    assert saved["planner"]["novelty"] == {"radius": 0.5}
    assert main(["train", f"resume={run}"]) == 0  # with METRA's networks, or they would not fit
    assert read_run(run).config == saved
    assert {"dual", "encoder_loss"} <= set(read_run(run).curves)


def test_a_composed_agent_is_tested_with_another_planner(run: Path) -> None:
    assert main(["evaluate", f"run={run}"]) == 0
    assert main(["evaluate", f"run={run}", "planner.budget.expansions=1"]) == 0
    same, fewer = read_run(run).evaluations
    solved = json.loads((run / "metrics.json").read_text())["solved"]
    assert same["results"]["test"]["solved"] == solved
    assert fewer["results"]["test"]["expansions"]["mean"] <= 4.0  # leaves of one wave
    assert fewer["changes"]["planner"]["budget"] == {"expansions": 1}


def test_a_run_of_another_objective_is_not_continued(run: Path, capsys) -> None:
    words = ["kit=waterworld", "objective=lsd", "toy=true", f"out={run}", "resume=true"]
    assert main(["train", *words]) == 1
    assert "holds a run with other settings: objective was" in capsys.readouterr().err


def test_every_combination_is_a_run_of_its_own(tmp_path: Path) -> None:
    words = ["kit=waterworld", "options=actions", "option_steps=10,20", f"out={tmp_path}"]
    assert main(["train", "-m", *words, "seed=1", "toy=true"]) == 0
    steps = [read_run(tmp_path / name).config["option_steps"] for name in ("0", "1")]
    assert steps == [10, 20]


def test_given_options_need_no_training(tmp_path: Path) -> None:
    words = ["kit=waterworld", "options=actions", "toy=true", "option_steps=20", f"out={tmp_path}"]
    assert main(["train", *words]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["train_base_steps"], metrics["solved"]) == (0, 3)
    assert not (tmp_path / "worker").exists()


def test_planner_keys_hold_in_algorithm_3s_rounds() -> None:
    words = ["algorithm=hmcts", "planner/tree_policy=puct", "planner.novelty.radius=0.4"]
    kit = make_kit(parse_config(DEMO, [*words, "planner.budget.until_plan=false"]))
    simulator = kit.make_simulator(TensorDictModule(lambda skill: skill, ["skill"], ["action"]))
    planner = kit.make_round_planner(simulator, tree_policy=UCT(2.0), seed=5)
    assert planner.tree_policy == PUCT()
    assert planner.novelty.radius == 0.4
    assert (planner.budget.expansions, planner.budget.until_plan) == (30, False)
    bare = make_kit(DemoConfig()).make_round_planner(simulator, tree_policy=UCT(2.0), seed=5)
    expected = MCTSPlanner(
        simulator,
        tree_policy=UCT(2.0),
        novelty=RadiusNovelty("position", 1.0),
        budget=SearchBudget(expansions=30),
        seed=5,
    )
    assert repr(bare) == repr(expected)


def test_the_atari_agent_is_found_as_a_kit(tmp_path: Path, monkeypatch) -> None:
    taken = []
    monkeypatch.setattr(train, "run_experiment", lambda *args, **_: taken.append(args) or 0)
    assert main(["train", "kit=atari", "env.game=Pong", "options=goals", f"out={tmp_path}"]) == 0
    (name, experiment, config, *_) = taken[0]
    assert (name, experiment.name) == ("train kit=atari", "atari")
    assert (config.game, config.source) == ("Pong", "goals")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["kit=atari", "options=luck"], "source is one of auto, best, goals"),
        (["kit=labmase"], "Unknown kit 'labmase'. Did you mean: labmaze"),
        (["kit=labmaze", "experiment=labmaze"], "say which experiment"),
        (["kit=waterworld", "objective=dayn"], "Did you mean: diayn"),
        (["kit=waterworld", "planner.gama=1"], "Did you mean: planner.gamma"),
    ],
)
def test_what_is_no_agent_is_refused_before_any_work(capsys, words, message) -> None:
    assert main(["train", *words]) == 2
    assert message in capsys.readouterr().err
