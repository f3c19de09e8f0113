"""The checks for users refuse parts that are broken on purpose, and name what is wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import StepCounter, Transform

from torchrl_hmcts.modules import SkillDiscriminator, SkillPrior
from torchrl_hmcts.objectives import SkillDiscriminatorLoss
from torchrl_hmcts.testing import (
    ChainEnv,
    ContractError,
    PointMassEnv,
    TableEnv,
    check_env,
    check_loss,
    check_macro_env,
    check_skill_objective,
    check_skill_prior,
    check_termination,
    check_transform,
    check_worker,
)

# ----------------------------------------------------------------------------------- envs


def broken(base: type, **methods: Callable[..., Any]) -> Callable[[str], type]:
    """Return a function of a name that makes a subclass whose methods end otherwise.

    What a method returns is given to the function of its name, after what it was called with.
    """

    def other(name: str, change: Callable[..., Any]) -> Callable[..., Any]:
        def method(self: Any, *args: Any, **kwargs: Any) -> Any:
            return change(getattr(base, name)(self, *args, **kwargs), self, *args)

        return method

    changed = {name: other(name, change) for name, change in methods.items()}
    return lambda name: type(name, (base,), changed)


def adds_to_reward(number: Callable[..., Any]) -> Callable[..., Any]:
    return lambda out, env, td: out.set("reward", out["reward"] + number(env, td))


def count(env: Any, td: TensorDictBase) -> int:
    env.steps = getattr(env, "steps", 0) + 1
    return env.steps


def overwrite(out: TensorDictBase, env: Any, td: TensorDictBase) -> TensorDictBase:
    td["state"].copy_(out["state"])
    return out


def unseeded(env: Any, td: TensorDictBase) -> float:
    return np.random.default_rng().random()


class IgnoresStep(ChainEnv):
    """Of a fixed batch size, and so itself to look at ``"_step"``, which it does not."""

    batch_locked = True


class ForgetsItsState(ChainEnv):
    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return super()._reset(tensordict)


class HiddenClock(broken(ChainEnv, _step=adds_to_reward(count))("Counts")):  # type: ignore[misc]
    """Its reward depends on a counter that is in no spec."""

    def _set_seed(self, seed: int | None) -> None:
        self.steps = 0


class MixesTickets(ChainEnv):
    """Gives whoever waits what was begun last."""

    def step_async(self, tensordict: TensorDictBase) -> int:
        self.last = tensordict
        return 0

    def step_wait(self, ticket: int) -> TensorDictBase:
        return self._step(self.last)

    def step_abandon(self, ticket: int) -> None:
        pass


as_double = broken(ChainEnv, _step=lambda out, *_: out.set("reward", out["reward"].double()))
of_the_batch = adds_to_reward(lambda env, td: float(td["state"].numel()))


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (as_double("WrongDtype")(), "WrongDtype fails TorchRL's check_env_specs"),
        (
            broken(ChainEnv, _step=adds_to_reward(unseeded))("Unseeded")(),
            r"Unseeded: two rollouts with seed 0 differ in .*reward",
        ),
        (IgnoresStep(batch_size=[4]), "IgnoresStep: 'state' changed where \"_step\" is False"),
    ],
)
def test_an_env_that_is_broken_is_refused(env: ChainEnv, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        check_env(env)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (ForgetsItsState(), "set to a state it shows another 'state'"),
        (HiddenClock(), "HiddenClock: .*'reward'"),
        (
            broken(ChainEnv, _step=of_the_batch)("LooksAtItsNeighbours")(),
            "set to a state and stepped it gives 'reward'",
        ),
        (broken(ChainEnv, _step=overwrite)("Overwrites")(), "Overwrites.*'state'"),
        (MixesTickets(), r"MixesTickets: step 0 of \d+ under way gave .*Keep apart"),
        (PointMassEnv(continuous=True), "PointMassEnv fails as the simulator .* discrete action"),
        (TableEnv({(0, 0): (1, 0.0, 0), (1, 0): (0, 0.0, 1)}), "a step took 0 base steps"),
    ],
)
def test_an_env_that_cannot_be_planned_in_is_refused(env: Any, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        check_macro_env(env)


# ------------------------------------------------------------------------------ transforms


class Adds(Transform):
    """Writes what is not in the specs."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("extra", torch.zeros(*next_tensordict.batch_size, 1))

    def _reset(self, tensordict: TensorDictBase, reset: TensorDictBase) -> TensorDictBase:
        return reset.set("extra", torch.zeros(*reset.batch_size, 1))


class Doubles(Transform):
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("reward", 2 * next_tensordict["reward"] + 1)


class KeepsNothing(Transform):
    """A state dict with one entry that loading forgets."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(()))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.count += 1
        return next_tensordict

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        pass


@pytest.mark.parametrize(
    ("make", "check", "kwargs", "message"),
    [
        (Adds, "single", {}, r"(?s)Adds fails on an env \('single'\).*extra"),
        (Adds, "trans_serial", {}, r"Adds fails around a SerialEnv \('trans_serial'\)"),
        (Adds, "serial", {"inside_workers": False}, "Adds is silently accepted inside a SerialEnv"),
        (Adds, "replay_buffer", {}, "Adds is silently accepted on a replay buffer"),
        (StepCounter, "env", {"writes": ["count"]}, r"StepCounter wrote no \('next', 'count'\)"),
        (Doubles, "env", {}, r"Doubles changed \('next', 'reward'\) of the env"),
        (StepCounter, "inverse", {"inverse_writes": ["push"]}, "inv wrote no 'push'"),
        (KeepsNothing, "state_dict", {}, "count' of the state dict is another"),
    ],
)
def test_a_transform_that_is_broken_is_refused(
    make: Callable, check: str, kwargs: dict, message: str
) -> None:
    with pytest.raises(ContractError, match=message):
        check_transform(make, ChainEnv, checks=[check], **kwargs)


def test_a_transform_is_to_be_made_anew_and_checks_have_names() -> None:
    one = StepCounter()
    with pytest.raises(ContractError, match="gave the same StepCounter twice"):
        check_transform(lambda: one, ChainEnv)
    with pytest.raises(ValueError, match="no check 'paralel'"):
        check_transform(StepCounter, ChainEnv, checks=["paralel"])


def test_a_transform_of_data_is_checked_on_data() -> None:
    data = TensorDict(state=torch.arange(3), batch_size=[3])

    class Plus(Transform):
        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            return tensordict.copy().set("plus", tensordict["state"] + 1)

    places = ["no_env", "compose", "model", "replay_buffer"]
    check_transform(Plus, ChainEnv, data=data, data_writes=["plus"], checks=places)
    for place in places:
        with pytest.raises(ContractError, match="Plus wrote no 'minus'"):
            check_transform(Plus, ChainEnv, data=data, data_writes=["minus"], checks=[place])
    with pytest.raises(ContractError, match="Plus is silently accepted on data"):
        check_transform(Plus, ChainEnv, checks=["no_env"])


# ---------------------------------------------------------------------------------- losses


def transitions() -> TensorDict:
    after = TensorDict(displacement=torch.randn(4, 2), batch_size=[4])
    return TensorDict(skill=torch.arange(4) % 3, next=after, batch_size=[4])


Good = SkillDiscriminatorLoss


def reduce_again(loss: Tensor, self: Any, *_: Any) -> Tensor:
    return loss / (2.0 if self.reduction == "mean" else 1.0)


def spoil(out: dict[str, Tensor], self: Any, td: TensorDictBase) -> dict[str, Tensor]:
    td["skill"].zero_()
    return out


def make_late(out: dict[str, Tensor], self: Any, td: TensorDictBase) -> dict[str, Tensor]:
    self.register_buffer("late", torch.zeros(()))
    return out


def read_by_its_name(logits: Tensor, self: Any, td: TensorDictBase) -> Tensor:
    return logits + 0 * td.get("skill").sum()


def undetached(out: dict[str, Tensor], *_: Any) -> dict[str, Tensor]:
    return {**out, "discriminator_accuracy": out["loss_discriminator"] * 1.0}


Undetached = broken(Good, losses=undetached)("Undetached")
ReducesTwice = broken(Good, _reduce=reduce_again)("ReducesTwice")
ForgetsKeys = broken(Good, skill_logits=read_by_its_name)("ForgetsKeys")
Lazy = broken(Good, losses=make_late)("Lazy")
Detached = broken(Good, losses=lambda out, *_: {k: v.detach() for k, v in out.items()})("Detached")
Spoils = broken(Good, losses=spoil)("Spoils")
AsksItsNeighbours = broken(Good, reward=lambda r, *_: r - r.mean())("AsksItsNeighbours")
WithGradient = broken(Good, reward=lambda r, self, td: self.skill_logits(td)[..., :1])(
    "WithGradient"
)


class Asks(Good):
    @property
    def next_features(self) -> list:  # type: ignore[override]
        return [*super().next_features, "velocity"]


def factory(cls: type) -> Callable[..., SkillDiscriminatorLoss]:
    def make(name: Callable, **kwargs: Any) -> SkillDiscriminatorLoss:
        keys = {"in_keys": [name("displacement")], "skill_logits_key": name("skill_logits")}
        return cls(SkillDiscriminator(2, 3, **keys), **kwargs)

    return make


@pytest.mark.parametrize(
    ("cls", "check", "message"),
    [
        (Undetached, "out_keys", "'discriminator_accuracy' has a gradient"),
        (Spoils, "out_keys", "changed 'skill' of its input"),
        (ReducesTwice, "reduction", r"ReducesTwice\(reduction='mean'\): 'loss_discriminator'"),
        (Detached, "gradients", "has no gradient for 'discriminator_params'"),
        (Asks, "dispatch", r"announces the in_key \('next', 'velocity'\)"),
        (ForgetsKeys, "nested_keys", "ForgetsKeys fails with renamed keys"),
        (Lazy, "state_dict", "its first use changed the state dict by .*late"),
        (Good, "target_networks", "SkillDiscriminatorLoss has no target_actor_params"),
    ],
)
def test_a_loss_that_is_broken_is_refused(cls: type, check: str, message: str) -> None:
    gradients = {"loss_discriminator": ["discriminator_params"]}
    targets = ["actor"] if check == "target_networks" else []
    with pytest.raises(ContractError, match=message):
        check_loss(
            factory(cls), transitions(), gradients=gradients, targets=targets, checks=[check]
        )


def test_a_gradient_that_strays_is_named() -> None:
    with pytest.raises(ContractError, match="has a gradient for .*discriminator_params.* only"):
        check_loss(
            factory(Good),
            transitions(),
            gradients={"loss_discriminator": ["encoder_params"]},
            checks=["gradients"],
        )


@pytest.mark.parametrize(
    ("cls", "message"),
    [
        (AsksItsNeighbours, "AsksItsNeighbours.reward gives transition 0 .* alone"),
        (WithGradient, "WithGradient.reward has a gradient"),
    ],
)
def test_an_objective_whose_reward_is_broken_is_refused(cls: type, message: str) -> None:
    check_skill_objective(factory(Good), transitions(), checks=["out_keys"])
    with pytest.raises(ContractError, match=message):
        check_skill_objective(factory(cls), transitions(), checks=[])


class Prior(SkillPrior):
    def __init__(self, p: list[float], log_p: list[float] | None = None) -> None:
        super().__init__(2)
        self.p, self.log_p = torch.tensor(p), log_p

    def probs(self) -> Tensor:
        return self.p

    def log_probs(self) -> Tensor:
        return super().log_probs() if self.log_p is None else torch.tensor(self.log_p)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (Prior([0.5, 0.6]), "Prior: probs.. sums to 1.1, not 1"),
        (Prior([1.5, -0.5]), "gives -0.5, below 0"),
        (Prior([1.0]), r"gives \[1\]; it must give \[2\]"),
        (Prior([0.5, 0.5], [0.0, 0.0]), "log_probs.. is not the logarithm"),
    ],
)
def test_a_prior_that_is_no_distribution_is_refused(prior: Prior, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        check_skill_prior(prior)


# --------------------------------------------------------------------------------- workers


def module(function: Callable) -> TensorDictModule:
    return TensorDictModule(function, ["skill"], ["action"])


class Normalised(nn.Module):
    """Its action depends on the mean of the batch."""

    def forward(self, skill: Tensor) -> Tensor:
        return (skill.float() - skill.float().mean() > -0.1).long()


def changes_the_state(td: TensorDictBase) -> TensorDictBase:
    return td.set("state", td["state"] * 0 + 1).set("action", td["skill"])


def one_dimension(skill: Tensor) -> Tensor:
    if skill.ndim > 1:
        raise ValueError("only one batch dimension")
    return skill


@pytest.mark.parametrize(
    ("worker", "message"),
    [
        (module(lambda skill: skill + 5), "TensorDictModule fails as the worker .*action"),
        (TensorDictModule(lambda x: x, ["x"], ["action"]), "reads 'x'"),
        (changes_the_state, "function changed 'state' of its input"),
        (module(one_dimension), r"acting for a batch of shape \[2, 2\].*one batch dimension"),
        (module(Normalised()), "the actions of an element alone and among others"),
    ],
)
def test_a_worker_that_is_broken_is_refused(worker: Any, message: str) -> None:
    check_worker(module(lambda skill: skill), ChainEnv(), 2)
    with pytest.raises(ContractError, match=message):
        check_worker(worker, ChainEnv(), 2)


@pytest.mark.parametrize(
    ("termination", "message"),
    [
        (lambda td: td["duration"], r"must give bool \[3\].*torch.int64"),
        (
            lambda td: (td["duration"] > 2).any().expand(td.batch_size),
            "element 0 False alone and True among others",
        ),
        (lambda td: td.set("end", td["duration"] > 2)["end"], "changed .*end.* of its input"),
        (lambda td: td["durations"] > 2, "fails asked about a batch"),
    ],
)
def test_a_termination_that_is_broken_is_refused(termination: Callable, message: str) -> None:
    td = TensorDict(duration=torch.tensor([[1], [2], [3]]), batch_size=[3])
    check_termination(lambda td: td["duration"] > 2, td)
    with pytest.raises(ContractError, match=message):
        check_termination(termination, td)


def test_a_check_leaves_torchs_generator_as_it_was() -> None:
    data = transitions()
    before = torch.get_rng_state()
    check_env(ChainEnv(length=4))
    check_loss(factory(Good), data, checks=["out_keys"])
    assert torch.equal(before, torch.get_rng_state())
