"""Every loss keeps TorchRL's contract: keys, reductions, gradients, targets, dispatch, compile."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.modules import OneHotCategorical, ProbabilisticActor, ValueOperator
from torchrl.objectives import LossModule
from torchrl.objectives.utils import ValueEstimators

import torchrl_hmcts.objectives
from torchrl_hmcts.modules import (
    FixedSkillPrior,
    GrowingSkillPrior,
    LearnedSkillPrior,
    OptionModel,
    SkillActionCritic,
    SkillActor,
    SkillCritic,
    SkillDiscriminator,
    SkillDynamics,
    SkillEncoder,
    SkillMLP,
    SpectralLinear,
    TerminationNetwork,
)
from torchrl_hmcts.objectives import (
    A3CLoss,
    DIAYNLoss,
    DiscreteSkillSACLoss,
    ExpertIterationLoss,
    GoalCloningLoss,
    IntraOptionQLoss,
    LSDEncoderLoss,
    METRAEncoderLoss,
    NStepReturn,
    OptionModelLoss,
    OptionTerminationLoss,
    SkillDiscriminatorLoss,
    SkillDynamicsLoss,
    SkillObjective,
    SkillPriorLoss,
    SkillSACLoss,
)
from torchrl_hmcts.testing import (
    LOSS_CHECKS,
    check_loss,
    check_skill_objective,
    check_skill_prior,
)

Z, A = 3, 4  # skills, actions
N = 6  # transitions
SPEC, CATEGORICAL = Bounded(-1.0, 1.0, shape=(2,)), Categorical(A)
SIZES: dict[str, Any] = {"hidden": (8,), "activation": nn.Tanh}
SAC_ESTIMATORS = (ValueEstimators.TD0, ValueEstimators.TD1, ValueEstimators.TDLambda)


@pytest.fixture(autouse=True)
def _no_target_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchrl.objectives.common.rl_warnings", lambda: False)


# ------------------------------------------------------------------------------------ the data


def transitions(action: Tensor) -> TensorDict:
    """Transitions ``[N]`` with everything any of the losses reads."""
    g = torch.Generator().manual_seed(0)
    skill = torch.randint(Z, (N,), generator=g)
    terminated = torch.arange(N)[:, None] == 0

    def state() -> dict[str, Tensor]:
        names = ("velocity", "position")
        return {**{k: torch.randn(N, 2, generator=g) for k in names}, "skill": skill}

    root, after = state(), state()
    after.update(
        reward=torch.randn(N, 1, generator=g),
        duration=torch.randint(1, 9, (N, 1), generator=g),
        terminated=terminated,
        done=terminated.clone(),
    )
    return TensorDict(
        {**root, "action": action, "next": TensorDict(after, batch_size=[N])}, batch_size=[N]
    )


def discrete() -> TensorDict:
    return transitions(torch.arange(N) % A)


def one_hot() -> TensorDict:
    return transitions(nn.functional.one_hot(torch.arange(N) % A, A))


def continuous() -> TensorDict:
    return transitions(torch.linspace(-0.8, 0.8, 2 * N).reshape(N, 2))


def goals() -> TensorDict:
    return continuous().set("goal", torch.linspace(-2.0, 3.0, 2 * N).reshape(N, 2))


def segments(*, one_hot_action: bool = False) -> TensorDict:
    """Segments ``[2, 3]`` in which episodes end: one terminated, one truncated."""
    td = one_hot() if one_hot_action else discrete()
    td["next", "done"] = (torch.arange(N)[:, None] % 4) == 0
    td["action_log_prob"] = torch.full((N,), -1.4)  # what V-trace reads
    return td.reshape(2, 3)


def examples() -> TensorDict:
    g = torch.Generator().manual_seed(1)
    return TensorDict(
        velocity=torch.randn(N, 2, generator=g),
        policy_target=torch.rand(N, A, generator=g).softmax(-1),
        value_target=torch.rand(N, 1, generator=g),
        batch_size=[N],
    )


# ---------------------------------------------------------------------------------- the losses


def discriminator(name: Callable, **kwargs: Any) -> SkillDiscriminatorLoss:
    network = SkillDiscriminator(
        2, Z, in_keys=[name("position")], skill_logits_key=name("skill_logits"), **SIZES
    )
    return SkillDiscriminatorLoss(network, **kwargs)


def metra(name: Callable, **kwargs: Any) -> METRAEncoderLoss:
    keys = {"in_keys": [name("position")], "representation_key": name("representation")}
    return METRAEncoderLoss(SkillEncoder(2, Z, **keys, **SIZES), dual_init=2.0, **kwargs)


def lsd(name: Callable, **kwargs: Any) -> LSDEncoderLoss:
    keys = {"in_keys": [name("position")], "representation_key": name("representation")}
    encoder = SkillEncoder(2, Z, linear=SpectralLinear, **keys, **SIZES)
    return LSDEncoderLoss(encoder, **kwargs)


def dads(name: Callable, **kwargs: Any) -> SkillDynamicsLoss:
    keys: dict[str, Any] = {
        "in_keys": [name("position")],
        "target_key": name("position"),
        "loc_key": name("skill_loc"),
        "scale_key": name("skill_scale"),
    }
    return SkillDynamicsLoss(SkillDynamics(2, 2, Z, **keys, **SIZES), **kwargs)


def renamed_metra(name: Callable, reduction: str) -> METRAEncoderLoss:
    objective = metra(name, reduction=reduction)
    objective.set_keys(representation=name("representation"))
    return objective


def actor_and_critic(name: Callable, spec: Any) -> tuple[nn.Module, nn.Module]:
    keys: dict[str, Any] = {"in_keys": [name("velocity")], "skill_key": name("skill"), **SIZES}
    actor = SkillActor(2, spec, Z, action_key=name("action"), **keys)
    if spec is not SPEC:
        actions = int(spec.space.n)
        return actor, SkillCritic(2, actions, Z, action_value_key=name("action_value"), **keys)
    keys |= {"action_key": name("action"), "state_action_value_key": name("state_action_value")}
    return actor, SkillActionCritic(2, 2, Z, **keys)


def diayn(name: Callable, *, spec: Any = CATEGORICAL, **kwargs: Any) -> DIAYNLoss:
    network = discriminator(name).discriminator
    networks = (*actor_and_critic(name, spec), network)
    return DIAYNLoss(*networks, action_space=spec, fixed_alpha=False, **kwargs)


def discrete_sac(
    name: Callable, *, reduction: str = "mean", spec: Any = CATEGORICAL, **kwargs: Any
) -> DiscreteSkillSACLoss:
    parts = (*actor_and_critic(name, spec), renamed_metra(name, reduction))
    return DiscreteSkillSACLoss(*parts, action_space=spec, fixed_alpha=False, **kwargs)


def continuous_sac(name: Callable, *, reduction: str = "mean", **kwargs: Any) -> SkillSACLoss:
    parts = (*actor_and_critic(name, SPEC), renamed_metra(name, reduction))
    return SkillSACLoss(*parts, fixed_alpha=False, **kwargs)


def a3c(
    name: Callable, *, distribution: Any = torch.distributions.Categorical, **kwargs: Any
) -> A3CLoss:
    logits = TensorDictModule(nn.Linear(2, A), [name("velocity")], ["logits"])
    actor = ProbabilisticActor(
        logits,
        in_keys=["logits"],
        out_keys=[name("action")],
        distribution_class=distribution,
    )
    critic = ValueOperator(
        nn.Linear(2, 1), in_keys=[name("velocity")], out_keys=[name("state_value")]
    )
    return A3CLoss(actor, critic, **kwargs)


def option_values(name: Callable) -> TensorDictModule:
    return TensorDictModule(nn.Linear(2, Z), [name("velocity")], [name("action_value")])


def termination_network(name: Callable) -> TerminationNetwork:
    return TerminationNetwork(
        2,
        Z,
        in_keys=[name("velocity")],
        skill_key=name("skill"),
        termination_logits_key=name("termination_logits"),
        **SIZES,
    )


def always_the_same(make: Callable, name: Callable) -> nn.Module:
    """A network that a loss reads and does not hold: it is not in the loss's state dict."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(7)
        return make(name)


def termination(name: Callable, **kwargs: Any) -> OptionTerminationLoss:
    values = always_the_same(option_values, name)
    return OptionTerminationLoss(termination_network(name), values, **kwargs)


def intra_option(name: Callable, **kwargs: Any) -> IntraOptionQLoss:
    ends = always_the_same(termination_network, name)
    return IntraOptionQLoss(option_values(name), ends, **kwargs)


def option_model(name: Callable, **kwargs: Any) -> OptionModelLoss:
    model = OptionModel(
        lambda n: SkillMLP(2, n, num_skills=Z, **SIZES),
        [name("position"), name("skill")],
        {name("position"): 2},
        max_duration=9,
        num_models=2,
    )
    return OptionModelLoss(model, **kwargs)


class TwoHeads(nn.Linear):
    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        out = super().forward(x)
        return out[..., :A], out[..., A:]


def expert_iteration(name: Callable, **kwargs: Any) -> ExpertIterationLoss:
    out_keys = [name("logits"), name("state_value")]
    network = TensorDictModule(TwoHeads(2, A + 1), [name("velocity")], out_keys)
    return ExpertIterationLoss(network, **kwargs)


def skill_prior(name: Callable, **kwargs: Any) -> SkillPriorLoss:
    return SkillPriorLoss(LearnedSkillPrior(Z, [0.3, -0.2, 0.0]), **kwargs)


def goal_cloning(name: Callable, **kwargs: Any) -> GoalCloningLoss:
    actor = TensorDictModule(nn.Linear(2, 2), [name("goal")], [name("action")])
    return GoalCloningLoss(actor, **kwargs)


@dataclass
class Case:
    """A loss, data for it, and what is expected of it."""

    make: Callable[..., LossModule]
    data: Callable[[], TensorDict]
    gradients: dict[str, list[str]]
    targets: Sequence[str] = ()
    value_estimators: Sequence[Any] = ()


METRA_GRADIENTS = {"loss_encoder": ["encoder_params"], "loss_dual": ["log_dual"]}
DISCRIMINATOR_GRADIENTS = {"loss_discriminator": ["discriminator_params"]}


def sac(make: Callable, data: Callable, objective: dict[str, list[str]]) -> Case:
    gradients = {
        "loss_actor": ["actor_network_params"],
        "loss_qvalue": ["qvalue_network_params"],
        "loss_alpha": ["log_alpha"],
        **{loss: [f"objective.{own[0]}"] for loss, own in objective.items()},
    }
    return Case(make, data, gradients, ["qvalue_network"], SAC_ESTIMATORS)


def a3c_case(make: Callable, data: Callable) -> Case:
    gradients = {
        "loss_objective": ["actor_network_params"],
        "loss_entropy": ["actor_network_params"],
        "loss_critic": ["critic_network_params"],
    }
    return Case(make, data, gradients, (), (NStepReturn, *ValueEstimators))


with_one_hot = functools.partial
OPTION_MODEL_PARTS = ("delta", "reward", "duration", "terminated")
CASES = {
    "a3c": a3c_case(a3c, segments),
    "a3c_one_hot": a3c_case(
        with_one_hot(a3c, distribution=OneHotCategorical),
        with_one_hot(segments, one_hot_action=True),
    ),
    "diayn": sac(diayn, discrete, DISCRIMINATOR_GRADIENTS),
    "diayn_one_hot": sac(with_one_hot(diayn, spec=OneHot(A)), one_hot, DISCRIMINATOR_GRADIENTS),
    "discrete_sac": sac(discrete_sac, discrete, METRA_GRADIENTS),
    "continuous_sac": sac(continuous_sac, continuous, METRA_GRADIENTS),
    "discriminator": Case(discriminator, discrete, DISCRIMINATOR_GRADIENTS),
    "metra": Case(metra, discrete, METRA_GRADIENTS),
    "lsd": Case(lsd, discrete, {"loss_encoder": ["encoder_params"]}),
    "dads": Case(dads, discrete, {"loss_dynamics": ["dynamics_params"]}),
    "termination": Case(
        termination, discrete, {"loss_termination": ["termination_network_params"]}
    ),
    "intra_option": Case(
        intra_option, discrete, {"loss_qvalue": ["qvalue_network_params"]}, ["qvalue_network"]
    ),
    "option_model": Case(
        option_model, discrete, {f"loss_{part}": ["model."] for part in OPTION_MODEL_PARTS}
    ),
    "expert_iteration": Case(
        expert_iteration,
        examples,
        {"loss_policy": ["network_params"], "loss_value": ["network_params"]},
    ),
    "goal_cloning": Case(goal_cloning, goals, {"loss_actor": ["actor_network_params"]}),
    "skill_prior": Case(skill_prior, discrete, {"loss_skill_prior": ["prior."]}),
}
OBJECTIVES = ["discriminator", "metra", "lsd", "dads"]
# One of each kind: seconds each, and up to 15 for the others.
QUICK_TO_COMPILE = set("diayn discriminator dads termination expert_iteration skill_prior".split())
CHEAP_CHECKS = [check for check in LOSS_CHECKS if check != "compile"]


def run(name: str, check: str) -> None:
    case = CASES[name]
    check_loss(
        case.make,
        case.data(),
        gradients=case.gradients,
        targets=case.targets,
        value_estimators=case.value_estimators,
        checks=[check],
    )


@pytest.mark.parametrize("check", CHEAP_CHECKS)
@pytest.mark.parametrize("name", CASES)
def test_a_loss_keeps_the_contract(name: str, check: str) -> None:
    run(name, check)


@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt:FutureWarning")
@pytest.mark.parametrize(
    "name",
    [n if n in QUICK_TO_COMPILE else pytest.param(n, marks=pytest.mark.slow) for n in CASES],
)
def test_a_loss_compiles_into_one_graph(name: str) -> None:
    run(name, "compile")


@pytest.mark.parametrize("name", OBJECTIVES)
def test_the_reward_of_an_objective_keeps_the_contract(name: str) -> None:
    case = CASES[name]
    check_skill_objective(case.make, case.data(), checks=["out_keys"])


@pytest.mark.parametrize(
    "prior",
    [FixedSkillPrior(3, [2.0, 1.0, 0.0]), GrowingSkillPrior(4), LearnedSkillPrior(2, [0.5, 0.0])],
    ids=lambda prior: type(prior).__name__,
)
def test_every_prior_is_a_distribution(prior: Any) -> None:
    check_skill_prior(prior)


def test_no_loss_that_is_exported_is_left_out() -> None:
    covered = {type(case.make(lambda key: key)) for case in CASES.values()}
    exported = {getattr(torchrl_hmcts.objectives, n) for n in torchrl_hmcts.objectives.__all__}
    losses = {c for c in exported if isinstance(c, type) and issubclass(c, LossModule)}
    assert losses - {SkillObjective} == covered


VMAPPED = ["diayn", "discrete_sac", "continuous_sac"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt:FutureWarning")
@pytest.mark.parametrize("name", VMAPPED)
def test_without_vmap_a_loss_compiles_into_one_graph_too(name: str) -> None:
    case = CASES[name]
    make = functools.partial(case.make, deactivate_vmap=True)
    check_loss(make, case.data(), gradients=case.gradients, checks=["compile"])


@pytest.mark.parametrize("make", [diayn, discrete_sac])
def test_where_there_is_one_action_a_loss_is_the_same_in_both_encodings(make: Callable) -> None:
    losses = []
    for spec, data in ((Categorical(1), discrete()), (OneHot(1), one_hot())):
        action = data["action"][..., :1] * 0 + 1 if isinstance(spec, OneHot) else data["action"] * 0
        torch.manual_seed(0)
        losses.append(make(lambda key: key, spec=spec)(data.set("action", action)))
    for key in losses[0].keys():
        torch.testing.assert_close(losses[0][key], losses[1][key])


@pytest.mark.parametrize("name", CASES)
def test_a_priority_weight_may_be_nested_and_weighs_each_transition(name: str) -> None:
    case, outs = CASES[name], {}
    for reduction in ("none", "sum"):
        torch.manual_seed(0)
        loss = case.make(lambda key: key, reduction=reduction)
        if not hasattr(loss.tensor_keys, "priority_weight"):
            pytest.skip("has no priority weights")
        td = case.data()
        weight = torch.arange(td.numel()).reshape(td.shape)
        if reduction == "sum":
            loss.set_keys(priority_weight=("buffer", "weight"))
            td["buffer", "weight"] = weight.float()
        torch.manual_seed(1)
        outs[reduction] = loss(td)
    for key in outs["sum"].keys():
        if key.startswith("loss"):
            torch.testing.assert_close(outs["sum"][key], (weight * outs["none"][key]).sum())


@pytest.mark.parametrize("name", CASES)
def test_the_gradient_of_each_loss_matches_finite_differences(name: str) -> None:
    case = CASES[name]
    torch.manual_seed(0)
    loss = case.make(lambda key: key).double()
    for module in vars(loss).values():  # networks that it reads and does not hold
        if isinstance(module, nn.Module):
            module.double()
    td = case.data().apply(lambda x: x.double() if x.is_floating_point() else x)
    if name.startswith("a3c"):  # whose return rests on the critic, and is held
        td["advantage"], td["value_target"] = torch.randn(2, *td.shape, 1).double()
    loss(td.clone())
    loss.eval()  # no running mean and no power iteration moves below

    def value(key: str) -> Tensor:
        torch.manual_seed(1)  # of sampled actions
        return loss(td.clone())[key]

    for key, beginnings in case.gradients.items():
        loss.zero_grad()
        value(key).backward()
        parameters = [p for n, p in loss.named_parameters() if n.startswith(tuple(beginnings))]
        direction = [torch.randn_like(p) for p in parameters]
        slope = sum((p.grad * d).sum() for p, d in zip(parameters, direction, strict=True))
        sides = []
        for step in (1e-6, -2e-6, 1e-6):
            with torch.no_grad():
                for p, d in zip(parameters, direction, strict=True):
                    p.add_(d, alpha=step)
            sides.append(value(key).detach())
        # A spectral norm follows its matrix only with the next power iterations.
        rtol = 1e-4 if name == "lsd" else 1e-6
        torch.testing.assert_close(slope, (sides[0] - sides[1]) / 2e-6, rtol=rtol, atol=1e-7)


@pytest.fixture(autouse=True)
def _compiled_code_is_dropped() -> Iterator[None]:
    yield
    torch._dynamo.reset()


@pytest.mark.parametrize("kind", [NStepReturn, ValueEstimators.TD0, ValueEstimators.GAE])
def test_another_value_estimator_keeps_the_discount_of_the_loss(kind: Any) -> None:
    loss = a3c(lambda key: key, gamma=0.5)
    loss.make_value_estimator(kind)
    assert float(loss.value_estimator.gamma) == 0.5
    loss.make_value_estimator(kind, gamma=0.25)
    assert float(loss.value_estimator.gamma) == 0.25
