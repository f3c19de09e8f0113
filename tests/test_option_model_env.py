"""OptionModelEnv as a TorchRL env to plan in, and the recipe that learns one for Waterworld."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from maze_window import MazeWindow
from real_episodes import EpisodesInEachMaze, act
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.model_based import ModelBasedEnvBase
from torchrl.envs.utils import check_env_specs
from waterworld_options import (
    OptionModelConfig,
    error_by_horizon,
    make_model_env,
    make_option_model,
    record_transitions,
    relabel_targets,
    train_option_model,
)

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_from_text, maze_pool
from torchrl_hmcts.modules import OptionMemory, OptionModel, OptionModelEnv
from torchrl_hmcts.planners import HierarchicalPolicy, MCTSPlanner, RadiusNovelty
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.transforms import OptionTransform

LENGTH = 7


def make_chain(length: int = LENGTH) -> TransformedEnv:
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    return TransformedEnv(ChainEnv(length=length), OptionTransform(worker, 2, 2, gamma=0.9))


class ChainRule(nn.Module):
    """Knows the chain: option 1 goes 2 right, option 0 goes 2 left, the right end is the goal."""

    def __init__(self, out_features: int, shift: float = 0.0) -> None:
        super().__init__()
        self.shift = nn.Parameter(torch.full((), shift))
        self.out_features = out_features

    def forward(self, state: torch.Tensor, option: torch.Tensor) -> torch.Tensor:
        change = (4 * option - 2).to(torch.float32) + self.shift
        end = (state + change >= LENGTH - 1).to(torch.float32)
        steps = torch.full_like(change, 2.0)
        return torch.stack((change, 0.9 * end + 0.01, steps, 20.0 * end - 10.0), -1)


def make_rule(*shifts: float, env: EnvBase | None = None, **kwargs: Any) -> OptionModelEnv:
    shifts = shifts or (0.0,)
    left = iter(shifts)
    model = OptionModel(
        lambda n: ChainRule(n, next(left)),
        ["state", "option"],
        {"state": ()},
        max_duration=2,
        num_models=len(shifts),
    )
    return OptionModelEnv(model, make_chain() if env is None else env, **kwargs)


def at(state: int, option: int) -> TensorDict:
    return TensorDict(state=torch.tensor(state), option=torch.tensor(option))


def test_it_passes_torchrls_checks_and_has_the_specs_of_its_env() -> None:
    env, real = make_rule(), make_chain()
    check_env_specs(env)
    assert isinstance(env, ModelBasedEnvBase)
    assert not env.batch_locked
    for name in ("full_action_spec", "full_reward_spec", "full_done_spec", "observation_spec"):
        assert getattr(env, name) == getattr(real, name).to(env.device), name


def test_a_step_of_a_right_model_is_a_step_of_the_env() -> None:
    env, real = make_rule(min_reward=0.1), make_chain()
    for state in range(LENGTH - 1):
        for option in range(2):
            expected = real.step(at(state, option))["next"]
            if state + 4 * option - 2 in (LENGTH,):  # the env's last option takes one step
                continue
            got = env.step(at(state, option))["next"]
            for key in ("state", "duration", "terminated", "done"):
                assert torch.equal(got[key], expected[key]), (state, option, key)
            torch.testing.assert_close(got["reward"], expected["reward"], atol=0.011, rtol=0.0)


def test_predictions_are_rounded_and_kept_within_the_specs() -> None:
    env = make_rule(0.4)
    assert env.step(at(0, 0))["next", "state"].item() == 0  # 0 - 2 + 0.4
    after = env.step(at(2, 1))["next"]
    assert after["state"].item() == 4
    assert after["state"].dtype == torch.int64
    assert env.step(at(6, 1))["next", "state"].item() == LENGTH - 1


def test_rewards_within_the_noise_are_zero() -> None:
    assert make_rule().step(at(0, 1))["next", "reward"].item() == pytest.approx(0.01)
    assert make_rule(min_reward=0.1).step(at(0, 1))["next", "reward"].item() == 0.0
    assert make_rule(min_reward=0.1).step(at(4, 1))["next", "reward"].item() > 0.9


def test_steps_and_rollouts_are_deterministic_and_take_any_batch_shape() -> None:
    env = make_rule()
    td = TensorDict(state=torch.tensor([[0, 1, 2], [3, 4, 5]]), batch_size=[2, 3])
    td = env.reset(td, set_state=True)
    td["option"] = torch.ones(2, 3, dtype=torch.int64)
    first, second = (env.step(td.clone())["next"] for _ in range(2))
    assert first["state"].tolist() == [[2, 3, 4], [5, 6, 6]]
    assert first["done"].squeeze(-1).tolist() == [[False, False, False], [False, True, True]]
    assert (first == second).all()


def test_resets_are_reproducible_and_draw_from_recorded_starts() -> None:
    starts = TensorDict(state=torch.tensor([3, 5]), batch_size=[2])
    env = make_rule(starts=starts, batch_size=[50], seed=1)
    again = make_rule(starts=starts, batch_size=[50], seed=1)
    first = env.reset()["state"]
    assert set(first.tolist()) == {3, 5}
    assert torch.equal(first, again.reset()["state"])
    assert make_rule(seed=1).reset().keys() == env.reset().keys()


def test_a_state_that_lacks_entries_is_refused() -> None:
    with pytest.raises(ValueError, match="missing: \\['state'\\]"):
        make_rule().reset(TensorDict(), set_state=True)


def test_counters_grow_by_the_duration_up_to_the_time_limit() -> None:
    real = TransformedEnv(
        WaterworldMazeEnv(max_steps=100, observation=True, seed=0),
        OptionTransform(TensorDictModule(lambda skill: skill, ["skill"], ["action"]), 4, 25),
    )
    model = make_option_model(OptionModelConfig(num_models=1))
    model.output_mean[-1] = 25.0
    with torch.no_grad():
        for parameter in model.network_params.parameters():
            parameter.zero_()
    env = make_model_env(model, real)
    td = env.reset(real.reset(), set_state=True)
    td["option"] = torch.tensor(0)
    td["step_count"] = torch.tensor([60])
    after = env.step(td)["next"]
    assert after["step_count"].item() == 85
    assert not after["truncated"]
    after = env.step(after.set("option", torch.tensor(0)))["next"]
    assert after["step_count"].item() == 100
    assert after["truncated"]
    assert after["done"]


def test_what_the_model_does_not_predict_is_carried_or_read_out() -> None:
    real = TransformedEnv(
        WaterworldMazeEnv(seed=0),
        OptionTransform(TensorDictModule(lambda skill: skill, ["skill"], ["action"]), 4, 25),
    )
    model = make_option_model(OptionModelConfig(num_models=2))
    env = make_model_env(model, real)
    check_env_specs(env)
    td = real.reset().set("option", torch.tensor(1))
    after = env.step(td)["next"]
    assert torch.equal(after["target"], td["target"])
    assert torch.equal(after["maze_index"], td["maze_index"])
    assert torch.equal(after["observation"][:2], after["position"])
    assert torch.equal(after["observation"][2:], td["observation"][2:])


def test_disagreement_is_paid_for_or_ends_the_branch() -> None:
    # Members say 2 - 1 and 2 + 1: they agree on the mean and disagree by 1.
    plain = make_rule(-1.0, 1.0).step(at(4, 1))["next"]
    paid = make_rule(-1.0, 1.0, disagreement_coeff=0.5).step(at(4, 1))["next"]
    torch.testing.assert_close(paid["reward"], plain["reward"] - 0.5)
    wary = make_rule(-1.0, 1.0, max_disagreement=0.9).step(at(0, 1))["next"]
    assert wary["done"]
    assert not wary["terminated"]
    assert wary["reward"].item() == 0.0
    trusting = make_rule(-1.0, 1.0, max_disagreement=1.1).step(at(0, 1))["next"]
    assert not trusting["done"]


def test_a_planner_finds_the_shortest_plan_in_it() -> None:
    env = make_rule(min_reward=0.1)
    plan = MCTSPlanner(env, gamma=0.9).plan(make_chain().reset())
    assert plan.options.tolist() == [1, 1, 1]
    assert plan.durations.item() == 6


def test_replanning_solves_the_real_env_although_the_model_errs() -> None:
    real = make_chain(length=LENGTH)
    env = make_rule(0.6, min_reward=0.1)  # takes each option for 0.6 further than it leads
    policy = HierarchicalPolicy(MCTSPlanner(env, gamma=0.9), replan_every=1)
    td = real.rollout(10, policy=policy)
    assert td["next", "terminated"][-1].item()


def test_a_remembered_outcome_goes_before_the_prediction() -> None:
    env = make_rule()
    memory = OptionMemory(env.model, ["state"], 0.5, num_contexts=1, context_key="state")
    td = at(0, 1).unsqueeze(0)
    blocked = make_chain().reset(td, set_state=True).update({"duration": torch.tensor([[1]])})
    blocked.update({"reward": torch.zeros(1, 1), "terminated": torch.zeros(1, 1).bool()})
    memory.remember(td.set("next", blocked))
    wary = make_rule(memory=memory)
    assert wary.step(at(0, 1))["next", "state"].item() == 0
    assert wary.step(at(0, 1))["next", "duration"].item() == 1


def test_an_env_without_a_declared_state_gets_one() -> None:
    real = make_chain()
    real.base_env.state_spec = real.base_env.state_spec.empty()
    real.empty_cache()
    assert set(make_rule(env=real).state_spec.keys()) == {"state"}


def test_unusable_arguments_are_refused_with_their_value() -> None:
    with pytest.raises(ValueError, match=r"min_reward >= 0.*got -1"):
        make_rule(min_reward=-1.0)
    with pytest.raises(ValueError, match="the model has one"):
        make_rule(max_disagreement=0.5)
    model = OptionModel(lambda n: ChainRule(n), ["state"], {"place": ()}, max_duration=2)
    with pytest.raises(ValueError, match="'place'"):
        OptionModelEnv(model, make_chain())
    model = OptionModel(lambda n: ChainRule(n), ["state"], {"state": 2}, max_duration=2)
    with pytest.raises(ValueError, match=r"shape \[2\]"):
        OptionModelEnv(model, make_chain())


# ------------------------------------------------------------------ the recipe for Waterworld


class Push(TensorDictModuleBase):
    """A worker whose skills are the four thrusts."""

    in_keys, out_keys = ["skill"], ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", tensordict.get("skill"))


def test_the_window_shows_walls_target_and_free_ways_around_the_player() -> None:
    maze, _, _ = maze_from_text("...\n..#\n...")
    env = WaterworldMazeEnv(maze[None])
    td = env.make_state(0, position=(1.3, 1.5), target=(2.5, 2.5), velocity=(1.0, -2.0))
    td["option"] = torch.tensor(3)
    features = MazeWindow(4, radius=1, height=3, width=3)(td)["features"]
    assert features[:9].tolist() == [0, 0, 0, 0, 0, 1, 0, 0, 0]
    # Right and left, then down and up: left or upper rim, then the other; up to one tile.
    ways = [0.7 - 0.25, 1.0, 0.45, 1.0, 1.0, 1.0, 1.0, 1.0]
    torch.testing.assert_close(features[9:17], torch.tensor(ways))
    assert features[17:26].tolist() == [0, 0, 0, 0, 0, 0, 0, 0, 1]
    torch.testing.assert_close(features[26:30], torch.tensor([-0.4, 0.0, 1.0, -2.0]))
    torch.testing.assert_close(features[30:33], torch.tensor([1.0, 1.0, 1.0]))
    assert features[33:].tolist() == [0, 0, 0, 1]


def test_recording_counts_base_steps_and_sets_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any) -> None:
        raise AssertionError("a state was set")

    monkeypatch.setattr(WaterworldMazeEnv, "_reset_to_state", refuse)
    config = OptionModelConfig(base_steps=1_000, copies=4)
    data, steps = record_transitions(Push(), config)
    assert len(data) == 40
    assert steps == int(data["next", "duration"].sum()) <= 1_000
    assert "mask" in data["next", "trajectory"].keys()


def test_hindsight_asks_the_env_no_question_it_would_answer_otherwise() -> None:
    config = OptionModelConfig(base_steps=20_000, copies=40)
    data, _ = record_transitions(Push(), config)
    new = relabel_targets(data, gamma=config.gamma, seed=0)
    moved = (new["target"] != data["target"]).any(-1)
    assert moved.float().mean() > 0.8
    assert (new["next", "terminated"] & ~data["next", "terminated"]).sum() > 50
    env = TransformedEnv(WaterworldMazeEnv(), OptionTransform(Push(), 4, 25, config.gamma))
    again = env.step(new.exclude("next"))["next"]
    for key in ("position", "velocity", "reward", "terminated", "duration", "observation"):
        torch.testing.assert_close(again[key], new["next", key], msg=key)


def test_the_real_env_keeps_its_state_to_itself_and_cannot_be_set_or_planned_in() -> None:
    env = EpisodesInEachMaze(maze_pool("test"), 3, seed=0)
    td = env.reset()
    before = td["position"].clone()
    td["position"] = torch.full((3, 2), 4.5)  # it does not listen
    td["action"] = torch.zeros(3, dtype=torch.int64)
    after = env.step(td)["next"]
    assert (after["position"] - before).norm(dim=-1).max() < 0.2
    check_env_specs(env)
    with pytest.raises(RuntimeError, match="set_state"):
        env.reset(td, set_state=True)
    with pytest.raises(ValueError, match="cannot"):
        MCTSPlanner(TransformedEnv(env, OptionTransform(Push(), 4, 25)))


def test_the_real_env_acts_like_the_stateless_one() -> None:
    mazes = maze_pool("test")
    env = TransformedEnv(EpisodesInEachMaze(mazes, 4, seed=1), OptionTransform(Push(), 4, 25))
    torch.manual_seed(0)
    td = env.rollout(6, break_when_any_done=False)
    free = TransformedEnv(WaterworldMazeEnv(mazes), OptionTransform(Push(), 4, 25))
    state = td[:, 0].exclude("next")
    for i in range(6):
        state = free.step(state.set("option", td["option"][:, i]))["next"]
        torch.testing.assert_close(state["position"], td["next", "position"][:, i])


def test_acting_counts_the_steps_that_the_real_env_counts() -> None:
    mazes = maze_pool("test")
    real = TransformedEnv(EpisodesInEachMaze(mazes, 4, seed=0), OptionTransform(Push(), 4, 25))
    simulator = TransformedEnv(WaterworldMazeEnv(mazes), OptionTransform(Push(), 4, 25))
    policy = HierarchicalPolicy(
        MCTSPlanner(simulator, novelty=RadiusNovelty("position", 0.7)), replan_every=1
    )
    episodes = act(policy, real, max_options=20)
    assert episodes.solved.any()
    assert len(set(episodes.base_steps.tolist())) > 1  # some ended before others
    assert torch.equal(episodes.base_steps, real.base_env._now["step_count"][:, 0])
    summary = episodes.summary()
    assert summary["solved"] == int(episodes.solved.sum()) == round(4 * summary["share_solved"])


def test_a_perfect_model_has_no_error_at_any_horizon() -> None:
    mazes = maze_pool("test")
    real = TransformedEnv(EpisodesInEachMaze(mazes, 5, seed=0), OptionTransform(Push(), 4, 25))
    simulator = TransformedEnv(WaterworldMazeEnv(mazes), OptionTransform(Push(), 4, 25))
    assert error_by_horizon(simulator, real, 4) == [0.0] * 4


def test_a_little_training_beats_standing_still() -> None:
    config = OptionModelConfig(
        base_steps=20_000,
        copies=40,
        num_models=1,
        hidden=(64, 64),
        updates=200,
        hindsight=0,
        lr=4e-3,
    )
    data, _ = record_transitions(Push(), config)
    model = train_option_model(data, config)
    test, _ = record_transitions(Push(), OptionModelConfig(base_steps=10_000, seed=1))
    moved = (test["next", "position"] - test["position"]).norm(dim=-1).mean()
    predicted = model.predict(test)
    error = (predicted["position"] - test["next", "position"]).norm(dim=-1).mean()
    assert error < 0.5 * moved
