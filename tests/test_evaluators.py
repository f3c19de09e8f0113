"""What evaluators and priors say of a state: networks, rollouts, both."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from search_parts import CountingEnv, DeadEnd
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, ValueOperator

from torchrl_hmcts.planners import (
    MCTSPlanner,
    MixedEvaluator,
    ModulePrior,
    RolloutEvaluator,
    SearchBudget,
    ValueEvaluator,
)
from torchrl_hmcts.testing import ChainEnv, TableEnv


def at(env: Any, states: list[int], seeds: list[int] | None = None) -> TensorDictBase:
    """The given states of an env with a seed for each, as a planner hands them over."""
    td = env.reset(TensorDict({"state": torch.tensor(states)}, [len(states)]), set_state=True)
    return td.set("_seed", torch.tensor(list(range(len(states))) if seeds is None else seeds))


def bound(env: Any, evaluator: Any, gamma: float = 0.9) -> Any:
    MCTSPlanner(env, gamma=gamma, leaf_evaluator=evaluator)
    return evaluator


def right(td: TensorDictBase) -> Tensor:
    return torch.tensor([0.0, 1.0]).expand(len(td), 2)


def constant(value: float) -> Any:
    return lambda td: torch.full((len(td),), value)


# ---------------------------------------------------------------------- rollouts


def test_a_rollout_to_the_end_of_a_chain_earns_the_discounted_reward() -> None:
    env = ChainEnv(5)
    rollout = bound(env, RolloutEvaluator(right), gamma=0.9)
    values = rollout(at(env, [0, 1, 2, 3]))
    assert values.dtype == torch.float32
    torch.testing.assert_close(values, torch.tensor([0.9**3, 0.9**2, 0.9, 1.0]))


def test_the_return_of_a_rollout_discounts_every_option_by_its_duration() -> None:
    table = {(0, 0): (1, 1.0, 3), (1, 0): (2, 2.0, 2), (2, 0): (3, 4.0, 1)}
    env = TableEnv(table, terminal=[3])
    rollout = bound(env, RolloutEvaluator(num_rollouts=2), gamma=0.5)
    # 1 + 1/8 (2 + 1/4 * 4), twice
    assert rollout(at(env, [0])).tolist() == [1.375]
    assert rollout.num_base_steps == 2 * (3 + 2 + 1)


def test_a_rollout_that_is_cut_off_ends_with_what_the_bootstrap_says() -> None:
    env = ChainEnv(9)
    for bootstrap, expected in ((None, 0.0), (lambda td: td["state"].float(), 0.25 * 2)):
        rollout = RolloutEvaluator(right, max_options=2, bootstrap=bootstrap)
        assert bound(env, rollout, gamma=0.5)(at(env, [0])).tolist() == [expected]


def test_rollouts_that_have_ended_are_not_simulated() -> None:
    env = CountingEnv({(s, 0): (s + 1, 1.0, 1) for s in range(4)}, terminal=[4])
    rollout = bound(env, RolloutEvaluator(), gamma=1.0)
    assert rollout(at(env, [0, 3, 2])).tolist() == [4.0, 1.0, 2.0]
    assert [len(call) for call in env.calls] == [3, 2, 1, 1]
    assert rollout.num_base_steps == 7


def test_a_terminal_state_is_worth_nothing_and_a_truncated_one_its_bootstrap() -> None:
    env = CountingEnv({(0, 0): (1, 5.0, 1)}, terminal=[1])
    rollout = bound(env, RolloutEvaluator(bootstrap=constant(8.0)), gamma=0.5)
    terminal = env.step(at(env, [0]).set("action", torch.tensor([0])))["next"]
    env.calls.clear()
    assert rollout(terminal.set("_seed", torch.tensor([0]))).tolist() == [0.0]
    truncating = TableEnv({(0, 0): (1, 5.0, 1)}, truncated=[1])
    rollout = bound(truncating, RolloutEvaluator(bootstrap=constant(8.0)), gamma=0.5)
    truncated = truncating.step(at(truncating, [0]).set("action", torch.tensor([0])))["next"]
    assert rollout(truncated.set("_seed", torch.tensor([0]))).tolist() == [8.0]
    assert env.calls == []
    assert rollout.num_base_steps == 0


@pytest.mark.parametrize(("end", "expected"), [("terminal", 1.0), ("truncated", 1.0 + 0.25 * 8.0)])
def test_within_a_rollout_truncation_bootstraps_and_termination_does_not(
    end: str, expected: float
) -> None:
    env = TableEnv({(0, 0): (1, 1.0, 2)}, **{end: [1]})
    rollout = bound(env, RolloutEvaluator(bootstrap=constant(8.0)), gamma=0.5)
    assert rollout(at(env, [0])).tolist() == [expected]


def test_a_rollout_ends_where_no_option_may_be_taken() -> None:
    env = DeadEnd({(0, 0): (1, 1.0, 1), (1, 0): (2, 9.0, 1)}, terminal=[2])
    rollout = bound(env, RolloutEvaluator(bootstrap=constant(8.0)), gamma=0.5)
    assert rollout(at(env, [0])).tolist() == [1.0 + 0.5 * 8.0]
    assert rollout.num_base_steps == 1


# State 0 to a few others and back, rewards all different, one pair in four not allowed.
MAZE = {
    (s, a): ((3 * s + a + 1) % 7, 0.1 * s - 0.3 * a + 0.05, 1 + (s + a) % 3)
    for s in range(7)
    for a in range(4)
    if (s + a) % 4 != 3
}


@pytest.mark.parametrize("num_rollouts", [1, 3])
def test_the_value_of_a_state_does_not_depend_on_what_is_evaluated_beside_it(
    num_rollouts: int,
) -> None:
    env = TableEnv(MAZE)
    rollout = bound(env, RolloutEvaluator(num_rollouts=num_rollouts))
    states, seeds = [0, 5, 0, 2, 6], [11, 12, 13, 11, 2**62]
    together = rollout(at(env, states, seeds))
    alone = [rollout(at(env, [s], [seed])).item() for s, seed in zip(states, seeds, strict=True)]
    assert together.tolist() == alone
    assert together[0] != together[2]  # another seed, another rollout


def test_near_seeds_draw_unlike_options() -> None:
    # 64 neighbouring seeds, 8 draws of two options each: about half of all draws are 1, each seed
    # has its own sequence, and the order of draws has no pattern.
    env = CountingEnv({(s, a): (s, 0.0, 1) for s in range(64) for a in range(2)})
    bound(env, RolloutEvaluator(max_options=8))(at(env, list(range(64))))
    draws = np.array([[option for _, option in call] for call in env.calls])  # [8, 64]
    assert draws.shape == (8, 64)
    assert 0.4 < draws.mean() < 0.6
    assert len({tuple(column) for column in draws.T}) > 50
    assert (draws.mean(-1) > 0.25).all()
    assert (draws.mean(-1) < 0.75).all()


@pytest.mark.parametrize(
    ("policy", "expected"),
    [(None, 1.0), (lambda td: torch.tensor([0.2, 0.3, 0.5]).expand(len(td), 3), 1.3)],
)
def test_options_are_drawn_with_the_probabilities_of_the_policy(
    policy: Any, expected: float
) -> None:
    env = TableEnv({(0, a): (1, float(a), 1) for a in range(3)}, terminal=[1])
    rollout = bound(env, RolloutEvaluator(policy, num_rollouts=20_000))
    # The standard error of the mean is 0.006.
    assert rollout(at(env, [0])).item() == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("policy", [None, lambda td: torch.full((len(td), 4), 0.25)])
def test_rollouts_take_every_option_that_the_mask_allows_and_no_other(policy: Any) -> None:
    env = CountingEnv(MAZE)
    bound(env, RolloutEvaluator(policy, max_options=40))(at(env, list(range(7))))
    assert set(env.pairs) == set(MAZE)


def test_an_option_of_probability_zero_is_never_taken() -> None:
    env = CountingEnv({(0, a): (0, 0.0, 1) for a in range(4)})
    policy = lambda td: torch.tensor([0.0, 0.5, 0.0, 0.5]).expand(len(td), 4)  # noqa: E731
    bound(env, RolloutEvaluator(policy, max_options=20))(at(env, [0] * 50))
    assert {option for _, option in env.pairs} == {1, 3}


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (lambda td: torch.ones(len(td), 3), r"shape \[1, 3\].*\[1, 2\]"),
        (lambda td: td, "a tensor; got TensorDict.*ModulePrior"),
        (lambda td: torch.full((len(td), 2), float("nan")), "policy returned nan.*softmax"),
        (lambda td: torch.tensor([[-0.5, 1.5]]), "policy returned -0.5.*softmax"),
        (lambda td: torch.zeros(len(td), 2), "probability 0 to every option"),
    ],
)
def test_a_rollout_policy_that_returns_nonsense_is_named(policy: Any, message: str) -> None:
    env = ChainEnv(4)
    with pytest.raises((TypeError, ValueError), match=message):
        MCTSPlanner(env, leaf_evaluator=RolloutEvaluator(policy))(env.reset())


def test_rollouts_without_a_planner_or_seeds_say_what_is_missing() -> None:
    env = ChainEnv(4)
    rollout = RolloutEvaluator()
    with pytest.raises(RuntimeError, match="has no simulator yet.*leaf_evaluator"):
        rollout(at(env, [0]))
    with pytest.raises(ValueError, match=r'seed for each state from "_seed".*torch.arange'):
        bound(env, rollout)(at(env, [0]).exclude("_seed"))


def test_a_rollout_evaluator_serves_planners_of_one_env_and_discount_only() -> None:
    env = ChainEnv(4)
    rollout = bound(env, RolloutEvaluator(), gamma=0.9)
    bound(env, rollout, gamma=0.9)
    for other, gamma in ((ChainEnv(4), 0.9), (env, 0.8)):
        with pytest.raises(ValueError, match=r"another env or discount.*one for each planner"):
            bound(other, rollout, gamma)


# ---------------------------------------------------------------------- networks


class Pair(nn.Module):
    """Two outputs, of which the second is the value."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Linear(3, 2)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        out = self.net(x)
        return out[..., :1], out[..., 1:]


class Own(TensorDictModuleBase):
    """A module that TensorDictModule knows nothing of."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["x"], ["state_value"]
        self.net = nn.Linear(3, 1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("state_value", self.net(tensordict["x"]))


class Scaled(nn.Linear):
    """A network with a further argument, and one with a method of another name."""

    def forward(self, x: Tensor, scale: float = 1.0) -> Tensor:
        return scale * super().forward(x)

    def value(self, x: Tensor) -> Tensor:
        return -self(x)


def hooked() -> TensorDictModuleBase:
    """A module that a hook changes from outside."""
    module = TensorDictModule(nn.Linear(3, 1), in_keys=["x"], out_keys=["state_value"])
    module.register_forward_hook(lambda module, args, out: out.set("state_value", out["x"][:, :1]))
    return module


MODULES: dict[str, Any] = {
    "plain": lambda: TensorDictModule(nn.Linear(3, 1), ["x"], ["state_value"]),
    "flat": lambda: TensorDictModule(nn.Sequential(nn.Linear(3, 1), nn.Flatten(0)), ["x"], ["v"]),
    "nested": lambda: TensorDictModule(nn.Linear(3, 1), [("n", "x")], [("n", "v")]),
    "two inputs": lambda: TensorDictModule(nn.Bilinear(3, 2, 1), ["x", "y"], ["state_value"]),
    "two outputs": lambda: TensorDictModule(Pair(), ["x"], ["other", "state_value"]),
    "operator": lambda: ValueOperator(nn.Linear(3, 1), in_keys=["x"]),
    "keywords": lambda: TensorDictModule(nn.Linear(3, 1), {"input": "x"}, ["state_value"]),
    "method": lambda: TensorDictModule(Scaled(3, 1), ["x"], ["state_value"], method="value"),
    "arguments": lambda: TensorDictModule(
        Scaled(3, 1), ["x"], ["state_value"], method_kwargs={"scale": 2.0}
    ),
    "sequence of one": lambda: TensorDictSequential(
        TensorDictModule(nn.Linear(3, 1), ["x"], ["state_value"])
    ),
    "sequence": lambda: TensorDictSequential(
        TensorDictModule(nn.Linear(3, 4), ["x"], ["h"]),
        TensorDictModule(nn.Linear(4, 1), ["h"], ["state_value"]),
    ),
    "selected": lambda: TensorDictModule(Pair(), ["x"], ["other", "state_value"]).select_out_keys(
        "state_value"
    ),
    "hooked": hooked,
    "own": Own,
}


@pytest.mark.parametrize("name", MODULES)
def test_the_value_is_what_a_call_of_the_module_writes(name: str) -> None:
    module = MODULES[name]()
    key = {"flat": "v", "nested": ("n", "v")}.get(name, "state_value")
    x, y = torch.randn(5, 3), torch.randn(5, 2)
    td = TensorDict({"x": x, "y": y, "n": {"x": 2.0 * x}}, [5])
    before = {str(k): v.clone() for k, v in td.items(True, True)}
    evaluator = ValueEvaluator(module, key)
    values = evaluator(td)
    assert {str(k) for k in td.keys(True, True)} == set(before)
    for k, v in td.items(True, True):
        assert torch.equal(v, before[str(k)])
    assert torch.equal(values, module(td.clone())[key])
    assert evaluator.in_keys == list(module.in_keys)


def test_the_bookkeeping_of_a_plain_module_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def write(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("outputs were written to a tensordict")

    td = TensorDict({"x": torch.randn(5, 3), "y": torch.randn(5, 2)}, [5])
    monkeypatch.setattr(TensorDictModule, "_write_to_tensordict", write)
    for name in ("plain", "two inputs", "two outputs", "operator", "sequence of one"):
        assert ValueEvaluator(MODULES[name]())(td).shape == (5, 1)
    with pytest.raises(AssertionError, match="were written"):
        ValueEvaluator(MODULES["keywords"]())(td)


def value_of_state() -> TensorDictModule:
    """A value network on the state of a chain."""

    class Net(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layers = nn.Sequential(nn.Linear(1, 8), nn.Tanh(), nn.Dropout(0.5))
            self.last = nn.Linear(8, 1)

        def forward(self, state: Tensor) -> Tensor:
            return self.last(self.layers(state.to(torch.float32).unsqueeze(-1)))

    return TensorDictModule(Net(), in_keys=["state"], out_keys=["state_value"])


@pytest.mark.parametrize("training", [True, False])
def test_a_network_stays_its_owners(training: bool) -> None:
    module = value_of_state().train(training)
    env = ChainEnv(5)
    planner = MCTSPlanner(
        env, leaf_evaluator=ValueEvaluator(module), option_prior=ModulePrior(logits_of_state())
    )
    td = planner(env.reset())
    assert module.training is module.module.layers.training is training
    assert list(planner.parameters()) == []
    assert not td["root_value"].requires_grad
    assert all(p.grad is None and p.requires_grad for p in module.parameters())


def test_what_is_no_module_or_lacks_the_entry_is_refused() -> None:
    with pytest.raises(TypeError, match=r"needs a TensorDictModule; got Linear.*in_keys"):
        ValueEvaluator(nn.Linear(1, 1))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"reads 'state_value'; its module writes \['v'\]"):
        ValueEvaluator(TensorDictModule(nn.Linear(1, 1), ["x"], ["v"]))
    module = TensorDictModule(nn.Linear(1, 1), ["pixels"], ["state_value"])
    with pytest.raises(ValueError, match=r"reads 'pixels', which ChainEnv does not have"):
        MCTSPlanner(ChainEnv(3), leaf_evaluator=ValueEvaluator(module))


# ---------------------------------------------------------------------- priors


def logits_of_state(key: str = "logits") -> TensorDictModule:
    """Logits of two options: their difference is the state of the chain."""

    class Net(nn.Module):
        def forward(self, state: Tensor) -> Tensor:
            state = state.to(torch.float32)
            return torch.stack((torch.zeros_like(state), state), -1)

    return TensorDictModule(Net(), in_keys=["state"], out_keys=[key])


def test_a_prior_is_the_softmax_of_logits_or_the_probabilities_themselves() -> None:
    td = TensorDict({"state": torch.tensor([0, 2])}, [2])
    odds = torch.tensor([[0.5, 0.5], [1 / (1 + np.e**2), np.e**2 / (1 + np.e**2)]])
    raw = torch.tensor([[0.0, 0.0], [0.0, 2.0]])
    torch.testing.assert_close(ModulePrior(logits_of_state())(td), odds.float())
    torch.testing.assert_close(ModulePrior(logits_of_state("l"), logits_key="l")(td), odds.float())
    torch.testing.assert_close(ModulePrior(logits_of_state("probs"))(td), raw)
    torch.testing.assert_close(ModulePrior(logits_of_state("p"), prob_key="p")(td), raw)


def test_the_prior_of_an_actor_is_the_distribution_it_draws_from() -> None:
    actor = ProbabilisticActor(
        logits_of_state(), in_keys=["logits"], distribution_class=torch.distributions.Categorical
    )
    td = TensorDict({"state": torch.tensor([0, 1, 2])}, [3])
    torch.testing.assert_close(ModulePrior(actor)(td), actor.get_dist(td.clone()).probs)
    assert ModulePrior(actor).in_keys == ["state"]


def test_a_prior_that_is_not_there_or_not_clear_is_refused() -> None:
    with pytest.raises(ValueError, match=r"reads 'probs'; its module writes \['x'\]"):
        ModulePrior(logits_of_state("x"))
    with pytest.raises(ValueError, match="prob_key='a' and logits_key='b'"):
        ModulePrior(logits_of_state(), prob_key="a", logits_key="b")
    with pytest.raises(TypeError, match="needs a TensorDictModule; got function"):
        ModulePrior(right)  # type: ignore[arg-type]


# ---------------------------------------------------------------------- mixtures


@pytest.mark.parametrize(("weight", "expected"), [(0.0, 1.0), (0.25, 2.0), (1.0, 5.0)])
def test_a_mixture_weighs_its_parts(weight: float, expected: float) -> None:
    column = lambda td: torch.full((len(td), 1), 5.0)  # noqa: E731
    mixed = MixedEvaluator(constant(1.0), column, weight)
    assert mixed(TensorDict({}, [3])).tolist() == [expected] * 3


def test_a_mixture_hands_on_what_its_parts_need() -> None:
    env = ChainEnv(5)
    network = ValueEvaluator(value_of_state())
    rollout = RolloutEvaluator(right)
    mixed = bound(env, MixedEvaluator(network, rollout))
    assert mixed.in_keys == ["state"]
    assert mixed.is_random
    assert not MixedEvaluator(network, constant(0.0)).is_random
    network.module.eval()
    td = at(env, [0, 3])
    expected = 0.5 * network(td).flatten() + 0.5 * torch.tensor([0.9**3, 1.0])
    torch.testing.assert_close(mixed(td), expected)


def test_a_mixture_of_misfits_is_refused() -> None:
    mixed = MixedEvaluator(constant(0.0), lambda td: torch.zeros(len(td), 2))
    with pytest.raises(ValueError, match=r"second evaluator returned shape \[3, 2\].*\[3, 1\]"):
        mixed(TensorDict({}, [3]))


# ---------------------------------------------------------------------- in a planner


def test_the_steps_of_rollouts_are_counted_beside_the_budget() -> None:
    env = CountingEnv({(s, 0): (s + 1, 0.0, 1) for s in range(8)}, terminal=[8])
    rollout = RolloutEvaluator(max_options=2)
    planner = MCTSPlanner(env, leaf_evaluator=rollout, budget=SearchBudget(expansions=3))
    td = planner(env.reset())
    assert td["num_simulated_steps"].item() == 3
    assert rollout.num_base_steps == 2 * 4  # from the root and three new states
    assert sum(map(len, env.calls)) == 3 + 8
