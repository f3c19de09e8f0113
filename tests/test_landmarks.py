"""Options from recorded episodes: goals in hindsight, landmarks, jumps, and plans over them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import LazyMemmapStorage, TensorDictReplayBuffer
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.modules import LandmarkEnv, LandmarkModel, find_jumps
from torchrl_hmcts.objectives import GoalCloningLoss
from torchrl_hmcts.planners import HighestValue, MCTSPlanner, ProgressiveWidening, SearchBudget
from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.figures.intervals import wilson


def corridor(jumps: dict[float, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Walks from 0 to 5 in steps of 0.5, a jump to each place, so often, and 2 on from there."""
    walks, ends = [], []
    for place, times in jumps.items():
        walk = np.concatenate([np.arange(0.0, 5.5, 0.5), place + np.arange(0.0, 2.5, 0.5)])
        walks += [walk] * times
        ends += [np.arange(len(walk)) == len(walk) - 1] * times
    places = torch.from_numpy(np.concatenate(walks)).float()[:, None]
    return places, torch.from_numpy(np.concatenate(ends))


@pytest.fixture(scope="module")
def model() -> LandmarkModel:
    """3 of 4 jumps lead to 20, and one to 40."""
    return LandmarkModel.fit(*corridor({20.0: 9, 40.0: 3}), radius=1.0)


def at(model: LandmarkModel, *places: float) -> torch.Tensor:
    return model.nearest(torch.tensor(places)[:, None])


def test_jumps_are_steps_far_longer_than_the_median() -> None:
    places, ends = corridor({20.0: 1, 40.0: 1})
    assert torch.nonzero(find_jumps(places, ends)).flatten().tolist() == [10, 26]
    assert not find_jumps(places, ends, jump_factor=float("inf")).any()


def test_landmarks_lie_a_radius_apart_and_cover_all_places(model: LandmarkModel) -> None:
    plain = model.places[~model.is_jump]
    apart = torch.cdist(plain, plain) + 99 * torch.eye(len(plain))
    assert float(apart.min()) >= 1.0
    places, _ = corridor({20.0: 1, 40.0: 1})
    assert float(torch.cdist(places[~find_jumps(places, _)], plain).min(1).values.max()) <= 1.0
    assert model.places[model.is_jump].tolist() == [[5.0]]


def test_a_jump_is_one_option_with_outcomes_as_often_as_they_were(model: LandmarkModel) -> None:
    (jump,) = torch.nonzero(model.is_jump).flatten().tolist()
    assert int((model.targets[jump] >= 0).sum()) == 1
    shares = dict(
        zip(
            model.places[model.outcomes[jump, 0]].round().flatten().tolist(),
            model.probabilities[jump, 0].tolist(),
            strict=True,
        )
    )
    assert {near: share for near, share in shares.items() if share} == {20.0: 0.75, 40.0: 0.25}
    assert model.has_chance
    assert not LandmarkModel.fit(*corridor({5.5: 6}), radius=1.0).has_chance


def test_values_are_those_of_the_chain_with_chance(model: LandmarkModel) -> None:
    start, goal = at(model, 0.0, 22.0)
    (jump,) = torch.nonzero(model.is_jump).flatten()
    values = model.values(goal, 0.9)
    after = at(model, 20.0)[0]
    assert float(values[goal]) == 1.0
    assert float(values[jump]) == pytest.approx(0.9 * 0.75 * float(values[after]), rel=1e-5)
    assert float(values[at(model, 40.0)[0]]) == 0.0  # no way leads from there
    # 15 steps from 0 to 22; up to two fewer at each end and around the jump, within a radius.
    assert 0.9**15 <= float(values[start]) / 0.75 <= 0.9**9


def test_hindsight_would_take_a_lucky_jump_for_a_way(model: LandmarkModel) -> None:
    blind = LandmarkModel.fit(*corridor({20.0: 9, 40.0: 3}), radius=1.0, jump_factor=1e9)
    start, goal = at(blind, 0.0, 42.0)
    lucky = float(blind.values(goal, 0.999)[start])
    true = float(model.values(at(model, 42.0), 0.999)[at(model, 0.0)[0]])
    assert lucky > 0.95
    assert true == pytest.approx(0.25, abs=0.01)


def test_the_env_keeps_its_specs_and_draws_outcomes_as_often_as_recorded(
    model: LandmarkModel,
) -> None:
    env = LandmarkEnv(model, seed=0)
    check_env_specs(env)
    (jump,) = torch.nonzero(model.is_jump).flatten()
    state = TensorDict(landmark=jump.expand(4000), goal=at(model, 22.0).expand(4000))
    state.batch_size = [4000]
    td = env.reset(state, set_state=True).set("action", torch.zeros(4000, dtype=torch.int64))
    near = env.step(td)["next", "position"] < 30.0
    assert float(near.double().mean()) == pytest.approx(0.75, abs=0.03)


def test_a_search_finds_the_way_of_the_values(model: LandmarkModel) -> None:
    env = LandmarkEnv(model, gamma=0.99, seed=0)
    start, goal = at(model, 0.0, 22.0)
    table = model.values(goal, 0.99)

    class Values:
        in_keys = ("landmark",)

        def __call__(self, td: Any) -> torch.Tensor:
            return table[td["landmark"]]

    planner = MCTSPlanner(
        env,
        leaf_evaluator=Values(),
        chance=ProgressiveWidening(),
        backup="max",
        final_choice=HighestValue(),
        budget=SearchBudget(simulations=100, until_plan=False),
    )
    state = TensorDict(landmark=start[None], goal=goal[None], batch_size=[1])
    td = env.reset(state, set_state=True)
    option = planner(td)["action"]
    worth = 0.99 ** model.durations[start] * table[model.outcomes[start, :, 0]]
    assert float(worth[option[0]]) == pytest.approx(float(worth.max()), abs=1e-6)


@pytest.mark.parametrize("coeff", [0.0, 1.0])
def test_goal_cloning_weighs_actions_by_their_progress(coeff: float) -> None:
    actor = TensorDictModule(torch.nn.Linear(1, 1, bias=False), ["goal"], ["action"])
    with torch.no_grad():
        actor.module.weight.fill_(0.5)
    after = torch.tensor([[0.2], [-0.2]])  # progress 0.2 and -0.2, so A = 1 and -1
    td = TensorDict(
        position=torch.zeros(2, 1),
        goal=torch.ones(2, 1),
        action=torch.tensor([[1.5], [-0.5]]),  # errors -1 and 1
        next=TensorDict(position=after, batch_size=[2]),
        batch_size=[2],
    )
    loss = GoalCloningLoss(actor, progress_coeff=coeff)
    out = loss(td)
    assert out["loss_actor"].item() == pytest.approx(1.0)
    out["loss_actor"].backward()
    e = np.exp(coeff)  # weights e / mean and 1 / e / mean, with d error^2 / d weight of -2 and 2
    expected = (-2 * e + 2 / e) / (e + 1 / e)
    (gradient,) = (p.grad for p in loss.parameters())
    assert float(gradient) == pytest.approx(expected, rel=1e-5)


def test_shares_have_wilsons_interval() -> None:
    assert wilson(0, 10) == (0.0, 0.2775)
    assert wilson(5, 10) == (0.2366, 0.7634)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"radius": 0.0}, "radius.*got 0.0"),
        ({"radius": 1.0, "min_count": 100}, "no two of .* landmarks"),
        ({"radius": 1.0, "jump_factor": 0.0}, "jump_factor.*got 0.0"),
        ({"radius": 1.0, "hops": -1}, "hops.*got -1"),
    ],
)
def test_what_cannot_be_fitted_is_refused(keywords: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        LandmarkModel.fit(*corridor({20.0: 9}), **keywords)
    with pytest.raises(ValueError, match=r"places \[T, F\].*got \[4\]"):
        LandmarkModel.fit(torch.zeros(4), torch.ones(4, dtype=torch.bool), radius=1.0)


# ------------------------------------------------------------------------------ OGBench

NAME = "pointmaze-medium-navigate-v0"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("ogbench")
    path = tmp_path_factory.mktemp("data") / "medium"
    assert main(["data", f"id={NAME}", f"out={path}", "episodes=40"]) == 0
    return path


def test_episodes_are_recorded_as_the_seed_says_and_read_by_torchrl(
    folder: Path, tmp_path: Path
) -> None:
    from torchrl_hmcts.trainers.experiments.ogbench.data import load, record

    data = load(folder)
    assert [path.name for path in folder.parent.iterdir()] == ["medium"]  # and nothing half-written
    assert data.batch_size == torch.Size([40 * 1001])
    assert torch.nonzero(data["done"][:, 0]).flatten().diff().unique().tolist() == [1001]
    again = record(NAME, episodes=2)
    assert (again["observation"] == data["observation"][: 2 * 1001])[: 2 * 1001 - 1].all()
    steps = (data["observation"][1:] - data["observation"][:-1])[~data["done"][:-1, 0]]
    free = (steps.abs() > 0.0).all(1)
    moved, asked = steps[free], 0.2 * data["action"][:-1][~data["done"][:-1, 0]][free]
    assert float((moved - asked).abs().median()) < 1e-5  # but for walls, a step is 0.2 an action
    # With its clean-up TorchRL takes over Ctrl-C for the whole process.
    storage = LazyMemmapStorage(100, auto_cleanup=False)
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=8)
    buffer.extend(data[:100])
    assert buffer.sample()["observation"].shape == (8, 2)
    arrays = {"observations": data["observation"], "actions": data["action"]}
    np.savez(tmp_path / "own.npz", **arrays, terminals=data["done"][:, 0].float())
    assert (load(tmp_path / "own.npz") == data).all()
    np.savez(tmp_path / "other.npz", x=1)
    with pytest.raises(ValueError, match="lacks actions, observations, terminals"):
        load(tmp_path / "other.npz")


def test_the_agent_learns_offline_and_acts_from_the_command_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    words = [f"env.id={NAME}", f"data={folder}", f"out={out}", "episodes=1", "updates=800"]
    assert main(["train", "kit=ogbench", *words]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["test"]["episodes"] == 5
    assert metrics["test"]["solved"] >= 0.8
    assert (out / "search.png").is_file()
    curves = (out / "curves.csv").read_text()
    assert main(["train", f"resume={out}"]) == 0  # what was learned stays, with what it cost
    again = json.loads((out / "metrics.json").read_text())
    assert again["train_cpu_seconds"] == metrics["train_cpu_seconds"] > 0
    assert again["test"]["solved"] == metrics["test"]["solved"]
    assert (out / "curves.csv").read_text() == curves
    assert main(["evaluate", f"run={out}", "seed=1"]) == 0
    assert "1" in capsys.readouterr().out


def test_the_agent_reads_nothing_of_the_simulator(folder: Path) -> None:
    from torchrl_hmcts.envs.gym.settable import make_gym
    from torchrl_hmcts.trainers.experiments.ogbench.agent import fit_model, learn, make_agent
    from torchrl_hmcts.trainers.experiments.ogbench.config import OGBenchConfig
    from torchrl_hmcts.trainers.experiments.ogbench.data import load
    from torchrl_hmcts.trainers.experiments.ogbench.run import act_once

    class Blind:
        """Has reset and step; whatever else is asked of it raises."""

        def __init__(self) -> None:
            env = make_gym("pointmaze-medium-v0")
            self.reset, self.step, self.seed_globals = env.reset, env.step, env.seed_globals

        def __getattr__(self, name: str) -> Any:
            raise AssertionError(f"the agent asked for {name}")

    config = OGBenchConfig(id=NAME, updates=800)
    data = load(folder)
    model = fit_model(data, config)
    agent = make_agent(model, learn(data, model, config).loss.actor_network, config)
    episode = act_once(Blind(), agent, 1, [0, 1])  # type: ignore[arg-type]
    assert episode["solved"]
    assert episode["options"] > 5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["data", "id=pointmaze-gaint-navigate-v0"], "Did you mean: pointmaze-giant-navigate-v0"),
        (["data"], "say which dataset"),
        (["data", f"id={NAME}", "sede=1"], "sede"),
        (["data", f"id={NAME}", "episodes=-1"], "needs episodes >= 0; got -1"),
        (["train", "kit=ogbench", "env.id=antmaze"], "Unknown dataset"),
        (["train", "kit=ogbench", "data=/no/such"], "does not exist"),
    ],
)
def test_wrong_words(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("ogbench")
    assert main([*words, f"out={tmp_path / 'out'}"]) in (1, 2)
    assert message in capsys.readouterr().err
