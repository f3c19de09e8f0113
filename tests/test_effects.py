"""Effects found in recorded episodes, plans over them, and OGBench's puzzles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.modules import EffectModel, LandmarkEnv
from torchrl_hmcts.planners import HighestValue, MCTSPlanner, SearchBudget

RING = 0b11001, 0b00111, 0b01110, 0b11100, 0b10011  # a press flips a lamp and its two neighbours


def presses(effects: tuple[int, ...], steps: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Recorded lamps with their opposites, a clock, and where each press happened."""
    draws = np.random.default_rng(seed)
    lamps = np.zeros((steps, 5), np.int64)
    places = np.zeros((steps, 1))
    ends = np.arange(steps) % 100 == 99
    for t in range(1, steps):
        lamps[t] = lamps[t - 1]
        if ends[t - 1]:
            lamps[t] = draws.integers(0, 2, 5)  # another episode: no effect
        elif t % 3 == 0:
            a = int(draws.integers(len(effects)))
            lamps[t] ^= effects[a] >> np.arange(5) & 1
            places[t] = 10.0 * a + draws.normal(0.0, 0.1)
    seen = np.concatenate([lamps, 1 - lamps, np.arange(steps)[:, None], np.ones((steps, 1))], 1)
    return tuple(map(torch.from_numpy, (seen.astype(np.float32), ends, places.astype(np.float32))))


@pytest.fixture(scope="module")
def model() -> EffectModel:
    return EffectModel.fit(*presses(RING, 3000))


def test_switches_and_effects_are_found_with_their_places(model: EffectModel) -> None:
    assert model.columns.tolist() == [0, 1, 2, 3, 4]  # no opposite, no clock, no constant
    assert model.flips.tolist() == sorted(RING)
    assert model.duration == 3.0
    order = [RING.index(flip) for flip in model.flips.tolist()]
    assert torch.allclose(model.places[:, 0], 10.0 * torch.tensor(order), atol=0.1)


def test_a_rare_effect_is_an_accident() -> None:
    seen, ends, places = presses(RING[:3], 3000)
    other, _, _ = presses(RING[3:4], 90)
    both = torch.cat([seen, other]), torch.cat([ends, ends[:90]])
    assert EffectModel.fit(*both).num_options == 3
    assert EffectModel.fit(*both, min_share=0.01).num_options == 4


def test_settings_are_read_and_effects_named(model: EffectModel) -> None:
    before = torch.tensor([0, 0b00001, 0b10101])
    after = before ^ torch.tensor([RING[0], 0, RING[0] ^ RING[1]])
    (first,) = (model.flips == RING[0]).nonzero().flatten().tolist()
    assert model.effect(before, after).tolist() == [first, -1, -1]
    assert model.position(before)[1].tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]
    seen, *_ = presses(RING, 30)
    assert (model.position(model.settings(seen)) == seen[:, :5]).all()


def test_values_count_the_least_presses(model: EffectModel) -> None:
    values = model.values(torch.tensor([0]), 0.9)
    for chosen in range(32):  # of five lamps in a ring each set of presses leads elsewhere
        setting = 0
        for a in range(5):
            setting ^= RING[a] if chosen >> a & 1 else 0
        assert float(values[setting]) == pytest.approx(0.9 ** (3 * chosen.bit_count()), rel=1e-5)
    two = EffectModel.fit(*presses(RING[:2], 600))
    assert int((two.values(torch.tensor(0), 0.9) > 0.0).sum()) == 4  # what two effects reach


def test_a_search_presses_what_is_needed(model: EffectModel) -> None:
    env = LandmarkEnv(model, gamma=0.99, seed=0)
    check_env_specs(env)
    budget = SearchBudget(simulations=400, until_plan=False)
    planner = MCTSPlanner(env, backup="max", final_choice=HighestValue(), budget=budget)
    state = TensorDict(
        landmark=torch.tensor([RING[1] ^ RING[3]]), goal=torch.tensor([0]), batch_size=[1]
    )
    path = env.rollout(9, planner, tensordict=env.reset(state, set_state=True), auto_reset=False)
    assert {int(model.flips[a]) for a in path["action"].flatten()} == {RING[1], RING[3]}
    assert path["next", "duration"].flatten().tolist() == [3, 3]


def test_what_has_no_effects_is_refused() -> None:
    still = torch.zeros(10, 3)
    ends = torch.zeros(10, dtype=torch.bool)
    with pytest.raises(ValueError, match="of 3 columns 0 have two values"):
        EffectModel.fit(still, ends)
    with pytest.raises(ValueError, match=r"got \[10, 3\], \[9\] and \[10, 0\]"):
        EffectModel.fit(still, ends[:9])
    with pytest.raises(ValueError, match=r"got \[10, 3\], \[10\] and \[10\]"):
        EffectModel.fit(still, ends, still[:, 0])
    with pytest.raises(ValueError, match="at most 24 switches; got 25"):
        EffectModel(25, 1)


# ------------------------------------------------------------------------------ OGBench

NAME = "puzzle-3x3-play-v0"


class Blind:
    """Has reset and step; any other question to it raises."""

    def __init__(self, name: str) -> None:
        from torchrl_hmcts.envs.gym.settable import make_gym

        env = make_gym(name)
        self.reset, self.step, self.seed_globals = env.reset, env.step, env.seed_globals

    def __getattr__(self, name: str) -> Any:
        raise AssertionError(f"the agent asked for {name}")


def reach(observation: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """Above a place first, then down."""
    way = goal - observation[..., 12:15]
    near = way[..., :2].norm(dim=-1) < 0.15
    up = torch.where(near, way[..., 2] - 0.3, 2.0 - observation[..., 14])
    moves = torch.stack([way[..., 0], way[..., 1], up], -1).clamp(-0.5, 0.5) * 2
    moves[..., :2] *= (near | (observation[..., 14] > 1.6)).float()
    return torch.cat([moves, torch.zeros_like(moves[..., :1]), torch.ones_like(moves[..., :1])], -1)


@pytest.mark.filterwarnings("ignore:.*precision lowered:UserWarning")
def test_an_agent_presses_the_buttons_of_a_puzzle_and_reads_nothing_else(tmp_path: Path) -> None:
    pytest.importorskip("ogbench")
    from torchrl_hmcts.trainers.experiments.ogbench.agent import fit_model, learn, make_agent
    from torchrl_hmcts.trainers.experiments.ogbench.config import OGBenchConfig
    from torchrl_hmcts.trainers.experiments.ogbench.data import record
    from torchrl_hmcts.trainers.experiments.ogbench.run import act_once
    from torchrl_hmcts.trainers.figures.maps import plot_ways

    config = OGBenchConfig(id=NAME, updates=100)
    data = record(NAME, episodes=3)
    assert data["observation"].shape == (3 * 1001, 55)
    model = fit_model(data, config)
    assert model.num_landmarks == 2**9
    assert model.num_options == 9
    lamps = [bin(flip).count("1") for flip in model.flips.tolist()]
    assert sorted(lamps) == [3] * 4 + [4] * 4 + [5]  # corners, sides, the middle
    learned = learn(data, model, config)
    assert learned.curves["action_error"][-1] < 0.5
    worker = TensorDictModule(reach, ["observation", "goal"], ["action"])
    agent = make_agent(model, worker, config)
    episode = act_once(Blind("puzzle-3x3-v0"), agent, 1, [0, 1])  # type: ignore[arg-type]
    assert episode["solved"]
    assert episode["options"] == 2
    plot_ways(model, [episode["places"]], tmp_path / "ways.png")
    assert (tmp_path / "ways.png").stat().st_size > 10_000
