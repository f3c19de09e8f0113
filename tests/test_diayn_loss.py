"""Soft actor-critic on skills, with discrete actions (DIAYNLoss) and continuous ones.

test_contract_losses.py has what all losses share.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.objectives import DiscreteSACLoss, SACLoss

from torchrl_hmcts.modules import (
    ConcatSkillMLP,
    SkillActionCritic,
    SkillActor,
    SkillCritic,
    SkillDiscriminator,
    SkillMLP,
)
from torchrl_hmcts.objectives import DIAYNLoss, SkillDiscriminatorLoss, SkillSACLoss
from torchrl_hmcts.transforms import SkillReward


def make_loss(*, one_hot: bool = False, network: Any = SkillMLP, **kwargs: Any) -> DIAYNLoss:
    torch.manual_seed(0)
    spec = OneHot(4) if one_hot else Categorical(4)
    sizes = {"hidden": (8, 8), "activation": torch.nn.Tanh, "network": network}
    actor = SkillActor(2, spec, 3, in_keys=["velocity"], **sizes)
    critic = SkillCritic(4, 4, 3, in_keys=["velocity", "displacement"], **sizes)
    return DIAYNLoss(actor, critic, SkillDiscriminator(2, 3), action_space=spec, **kwargs)


def make_continuous(*, network: Any = SkillMLP, **kwargs: Any) -> SkillSACLoss:
    torch.manual_seed(0)
    spec = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0]), shape=(2,))
    objective = SkillDiscriminatorLoss(SkillDiscriminator(2, 3))
    sizes = {"hidden": (8, 8), "activation": torch.nn.Tanh, "network": network}
    actor = SkillActor(2, spec, 3, in_keys=["velocity"], **sizes)
    critic = SkillActionCritic(4, 2, 3, in_keys=["velocity", "displacement"], **sizes)
    return SkillSACLoss(actor, critic, objective, **kwargs)


def make_data(n: int = 6, *, one_hot: bool = False, continuous: bool = False) -> TensorDict:
    g = torch.Generator().manual_seed(0)
    skill = torch.randint(3, (n,), generator=g)
    action = torch.randint(4, (n,), generator=g)
    terminated = torch.arange(n)[:, None] == 0

    def state() -> dict[str, torch.Tensor]:
        names = ("velocity", "displacement")
        return {**{k: torch.randn(n, 2, generator=g) for k in names}, "skill": skill}

    root, after = state(), state()
    root["action"] = torch.nn.functional.one_hot(action, 4) if one_hot else action
    if continuous:
        root["action"] = torch.rand(n, 2, generator=g)
    after.update(
        reward=torch.randn(n, 1, generator=g), terminated=terminated, done=terminated.clone()
    )
    return TensorDict({**root, "next": TensorDict(after, batch_size=[n])}, batch_size=[n])


@pytest.fixture(autouse=True)
def _no_target_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchrl.objectives.common.rl_warnings", lambda: False)


def test_the_discriminator_loss_is_the_closed_form_cross_entropy() -> None:
    net = SkillDiscriminator(1, 2)
    linear = net.network[0]
    torch.nn.init.zeros_(linear.bias)
    with torch.no_grad():
        linear.weight.copy_(torch.tensor([[1.0], [0.0]]))
    td = TensorDict(
        skill=torch.tensor([0, 1]),
        next=TensorDict(displacement=torch.tensor([[math.log(3.0)], [0.0]]), batch_size=[2]),
        batch_size=[2],
    )
    # q(0 | log 3) = 3 / 4; q(1 | 0) = 1 / 2, where the first of two equal logits counts as guess.
    expected = torch.tensor([-math.log(0.75), -math.log(0.5)])
    out = SkillDiscriminatorLoss(net, reduction="none")(td)
    torch.testing.assert_close(out["loss_discriminator"], expected)
    assert out["discriminator_accuracy"].tolist() == [1.0, 0.0]


def test_losses_written_with_plain_torch_agree() -> None:
    loss, td = make_loss(gamma=0.8, alpha_init=0.2), make_data()
    out = loss(td.clone())
    actor, skill = loss.actor_network.network, td["skill"]

    def critic(i: int, state: TensorDict) -> torch.Tensor:
        params = loss.qvalue_network_params[i]
        with params.to_module(loss.qvalue_network, preserve_module_state=False):
            return loss.qvalue_network(state.clone())["action_value"]

    after = td["next"]
    log_pi = actor(td["velocity"], skill).log_softmax(-1)
    next_log_pi = actor(after["velocity"], skill).log_softmax(-1)
    next_q = torch.minimum(critic(0, after), critic(1, after))
    value = (next_log_pi.exp() * (next_q - 0.2 * next_log_pi)).sum(-1, keepdim=True)
    target = (after["reward"] + 0.8 * ~after["terminated"] * value).squeeze(-1).detach()
    q = [critic(i, td) for i in (0, 1)]
    errors = [(x.gather(-1, td["action"][:, None]).squeeze(-1) - target) ** 2 for x in q]
    torch.testing.assert_close(out["qvalue_loss_0"], errors[0].mean())
    torch.testing.assert_close(out["qvalue_loss_1"], errors[1].mean())
    torch.testing.assert_close(out["loss_qvalue"], sum(errors).mean())
    policy = (log_pi.exp() * (0.2 * log_pi - torch.minimum(*q))).sum(-1).mean()
    torch.testing.assert_close(out["loss_actor"], policy)
    torch.testing.assert_close(out["entropy"], -(log_pi.exp() * log_pi).sum(-1).mean())


@pytest.mark.parametrize("network", [SkillMLP, ConcatSkillMLP])
@pytest.mark.parametrize("continuous", [False, True])
def test_stacked_critics_agree_with_torchrls_vmap_and_loop(network: type, continuous: bool) -> None:
    td, outs = make_data(continuous=continuous), []
    make, parent = (make_continuous, SACLoss) if continuous else (make_loss, DiscreteSACLoss)
    for vmap in (None, False, True):
        loss = make(network=network, deactivate_vmap=vmap is False)
        if vmap is not None:
            parent._make_vmap(loss)
        torch.manual_seed(3)
        outs.append(loss(td.clone()))
    for out in outs[1:]:
        torch.testing.assert_close(outs[0].to_dict(), out.to_dict())


def test_the_short_cuts_agree_with_torchrls_own_losses() -> None:
    loss, td = make_loss(), make_data()
    torch.testing.assert_close(
        loss._compute_target(td), DiscreteSACLoss._compute_target(loss, td.clone())
    )
    parents = DiscreteSACLoss.forward(loss, td.clone())
    out = loss(td)
    for key in ("loss_actor", "loss_qvalue", "loss_alpha", "entropy"):
        torch.testing.assert_close(out[key], parents[key])


@pytest.mark.parametrize("one_hot", [False, True])
def test_an_actor_of_another_kind_is_asked_for_its_distribution(one_hot: bool) -> None:
    expected = make_loss()(make_data())
    for only_logits in (True, False):
        loss = make_loss(one_hot=one_hot)
        loss._only_logits = only_logits
        torch.testing.assert_close(loss(make_data(one_hot=one_hot)).to_dict(), expected.to_dict())


def test_a_truncated_state_has_a_value_and_a_terminal_one_none() -> None:
    td = make_data()
    td["next", "done"][:3] = True  # the first is terminated, the next two are truncated
    target = make_loss()._compute_target(td)
    undisturbed = make_loss()._compute_target(make_data())
    torch.testing.assert_close(target, undisturbed)
    assert target[0] == td["next", "reward"][0]
    assert (target[1:] != td["next", "reward"][1:].squeeze(-1)).all()


def test_what_is_learned_from_a_terminal_state_that_is_not_finite() -> None:
    """Nothing of the skill, the reward for the critic, and no reward from the objective."""
    td = make_data()
    td["next", "velocity"][0] = torch.nan
    td["next", "displacement"][0] = torch.inf
    loss = make_loss(reduction="none")
    out = loss(td.clone())
    assert out["loss_discriminator"][0] == 0
    assert out["loss_discriminator"][1:].all()
    expected = make_loss(reduction="none")(make_data())
    torch.testing.assert_close(out["loss_qvalue"], expected["loss_qvalue"])
    rewards = SkillReward(loss.objective)(td)["next", "reward"]
    assert rewards[0] == 0
    torch.testing.assert_close(rewards[1:], SkillReward(loss.objective)(td[1:])["next", "reward"])


def test_a_state_in_the_midst_of_an_episode_that_is_not_finite_is_not_hidden() -> None:
    td = make_data()
    td["next", "displacement"][1] = torch.nan
    assert make_loss()(td)["loss_discriminator"].isnan()


def test_without_target_critics_the_critics_themselves_bootstrap() -> None:
    expected = make_loss()(make_data())  # targets are still copies
    out = make_loss(delay_qvalue=False)(make_data())
    torch.testing.assert_close(out["loss_qvalue"], expected["loss_qvalue"])


def test_a_tuned_alpha_falls_when_the_entropy_is_above_its_target() -> None:
    loss = make_loss(fixed_alpha=False, target_entropy=0.1)
    loss(make_data())["loss_alpha"].backward()
    assert loss.log_alpha.grad > 0  # descent lowers log alpha


def test_a_state_dict_of_the_time_before_objectives_still_loads() -> None:
    first, second = make_loss(), make_loss()
    torch.nn.init.ones_(first.discriminator.network[0].weight)
    old = {
        k.replace("objective.", "discriminator_objective.", 1): v
        for k, v in first.state_dict().items()
    }
    second.load_state_dict(old)
    assert (second.discriminator.network[0].weight == 1.0).all()


def test_losses_of_continuous_actions_written_with_plain_torch_agree() -> None:
    loss, td = make_continuous(gamma=0.8, alpha_init=0.2), make_data(continuous=True)
    torch.manual_seed(5)
    out = loss(td.clone())
    actor, skill, after = loss.actor_network, td["skill"], td["next"]

    def critic(i: int, state: TensorDict, action: torch.Tensor) -> torch.Tensor:
        params = [p[i] for p in loss.qvalue_network_params.parameters()]
        x = torch.cat((state["velocity"], state["displacement"], action), -1)
        return loss.qvalue_network.network.run(params, x, skill).squeeze(-1)

    torch.manual_seed(5)  # the next action is drawn first
    dist = actor.get_dist(after.copy())
    next_action = dist.rsample()
    next_q = torch.minimum(critic(0, after, next_action), critic(1, after, next_action))
    value = next_q - 0.2 * dist.log_prob(next_action)
    target = after["reward"][:, 0] + 0.8 * ~after["terminated"][:, 0] * value
    errors = [(critic(i, td, td["action"]) - target.detach()) ** 2 for i in (0, 1)]
    torch.testing.assert_close(out["qvalue_loss_0"], errors[0].mean())
    torch.testing.assert_close(out["qvalue_loss_1"], errors[1].mean())
    torch.testing.assert_close(out["loss_qvalue"], sum(errors).mean())
    dist = actor.get_dist(td.copy())
    action = dist.rsample()
    q = torch.minimum(critic(0, td, action), critic(1, td, action))
    log_prob = dist.log_prob(action)
    torch.testing.assert_close(out["loss_actor"], (0.2 * log_prob - q).mean())
    torch.testing.assert_close(out["entropy"], -log_prob.mean())


def test_the_target_entropy_is_known_before_the_first_call() -> None:
    loss = make_continuous()
    assert {"_target_entropy", "_value_estimator.gamma"} <= set(loss.state_dict())
    assert loss.target_entropy == -2.0
    assert ("next", "action") not in loss.in_keys


def test_of_continuous_actions_a_terminal_state_may_be_anything_and_a_truncated_one_not() -> None:
    td = make_data(continuous=True)
    td["next", "done"][:3] = True  # the first is terminated, the next two are truncated
    td["next", "velocity"][0] = torch.nan
    losses = []
    for data in (td, make_data(continuous=True)):
        loss = make_continuous()
        torch.manual_seed(0)
        losses.append(loss(data)["loss_qvalue"])
    assert losses[0].isfinite()
    torch.testing.assert_close(losses[0], losses[1])
