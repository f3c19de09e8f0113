"""Continuous actions: actor, policy, critic and SkillSACLoss.

The trainer run is in test_skill_objectives.py, what all losses share in test_contract_losses.py.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.objectives import SACLoss

from torchrl_hmcts.modules import (
    ConcatSkillMLP,
    SkillActionCritic,
    SkillActor,
    SkillDiscriminator,
    SkillMLP,
    SkillPolicy,
)
from torchrl_hmcts.objectives import SkillDiscriminatorLoss, SkillSACLoss
from torchrl_hmcts.testing import PointMassEnv
from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform

SPEC = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0]), shape=(2,))


def make_env(copies: int = 16) -> TransformedEnv:
    return TransformedEnv(
        PointMassEnv([copies], continuous=True),
        Compose(SkillTransform(4, 50), DisplacementTransform()),
    )


def make_loss(*, network: Any = SkillMLP, **kwargs: Any) -> SkillSACLoss:
    torch.manual_seed(0)
    objective = SkillDiscriminatorLoss(SkillDiscriminator(2, 4))
    sizes = {"hidden": (8, 8), "activation": torch.nn.Tanh, "network": network}
    actor = SkillActor(2, SPEC, 4, in_keys=["velocity"], **sizes)
    critic = SkillActionCritic(4, 2, 4, in_keys=["velocity", "displacement"], **sizes)
    return SkillSACLoss(actor, critic, objective, **kwargs)


def make_data(n: int = 6) -> TensorDict:
    g = torch.Generator().manual_seed(0)
    skill = torch.randint(4, (n,), generator=g)
    terminated = torch.arange(n)[:, None] == 0

    def state() -> dict[str, torch.Tensor]:
        names = ("velocity", "displacement")
        return {**{k: torch.randn(n, 2, generator=g) for k in names}, "skill": skill}

    root, after = state(), state()
    root["action"] = torch.rand(n, 2, generator=g)
    after.update(
        reward=torch.randn(n, 1, generator=g), terminated=terminated, done=terminated.clone()
    )
    return TensorDict({**root, "next": TensorDict(after, batch_size=[n])}, batch_size=[n])


@pytest.fixture(autouse=True)
def _no_target_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchrl.objectives.common.rl_warnings", lambda: False)


# Actor and policy


def test_actions_keep_within_their_bounds() -> None:
    actor = SkillActor(2, SPEC, 4, in_keys=["velocity"])
    td = make_data(500)
    for policy in (actor, SkillPolicy(actor), SkillPolicy(actor, deterministic=True)):
        action = policy(td.copy())["action"]
        assert SPEC.expand(500, 2).is_in(action)
    assert not SkillPolicy(actor)(td)["action"].requires_grad


def test_a_batched_spec_has_the_bounds_of_one_action() -> None:
    env = make_env(3)
    actor = SkillActor(2, env.action_spec, 4, in_keys=["velocity"])
    assert actor.spec["action"].shape == (2,)
    data = env.rollout(2, SkillPolicy(actor))
    assert env.action_spec.unsqueeze(1).expand(3, 2, 2).is_in(data["action"])


def test_the_policy_shares_the_actors_parameters_and_takes_the_squashed_mean() -> None:
    actor = SkillActor(2, SPEC, 4, in_keys=["velocity"])
    policy = SkillPolicy(actor, deterministic=True)
    assert {id(p) for p in policy.parameters()} == {id(p) for p in actor.parameters()}
    td = make_data(20)
    loc = actor.module[0](td.copy())["loc"]
    expected = loc.tanh() * torch.tensor([1.0, 2.0]) + torch.tensor([0.0, 2.0])
    torch.testing.assert_close(policy(td)["action"], expected.detach())
    torch.testing.assert_close(
        policy(td)["action"], actor.get_dist(td).deterministic_sample.detach()
    )


def test_the_policy_samples_from_the_actors_distribution() -> None:
    actor = SkillActor(2, SPEC, 4, in_keys=["velocity"])
    policy = SkillPolicy(actor, generator=torch.Generator().manual_seed(0))
    td = TensorDict(
        velocity=torch.ones(20_000, 2),
        skill=torch.full((20_000,), 3),
        batch_size=[20_000],
    )
    ours = policy(td.copy())["action"]
    theirs = actor.get_dist(td).sample()
    torch.testing.assert_close(ours.mean(0), theirs.mean(0), atol=0.03, rtol=0)
    torch.testing.assert_close(ours.std(0), theirs.std(0), atol=0.03, rtol=0)
    again = SkillPolicy(actor, generator=torch.Generator().manual_seed(0))(td)["action"]
    assert torch.equal(ours, again)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (Bounded(-1.0, float("inf"), shape=(1,)), "finite bounds.*inf"),
        (Bounded(-1.0, 1.0, shape=()), r"last dimension; got Bounded.*shape \(\)"),
        (Bounded(0, 5, shape=(1,), dtype=torch.int64), "of floats.*torch.int64"),
    ],
)
def test_bad_specs_are_refused_with_their_value(spec: Bounded, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SkillActor(2, spec, 3, in_keys=["velocity"])


# The loss


def test_losses_written_with_plain_torch_agree() -> None:
    loss, td = make_loss(gamma=0.8, alpha_init=0.2), make_data()
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


@pytest.mark.parametrize("network", [SkillMLP, ConcatSkillMLP])
def test_stacked_critics_agree_with_torchrls_vmap_and_loop(network: type) -> None:
    outs = []
    for vmap in (None, False, True):
        loss = make_loss(network=network, deactivate_vmap=vmap is False)
        if vmap is not None:
            SACLoss._make_vmap(loss)
        torch.manual_seed(3)
        outs.append(loss(make_data()))
    for out in outs[1:]:
        torch.testing.assert_close(outs[0].to_dict(), out.to_dict())


def test_the_target_entropy_is_known_before_the_first_call() -> None:
    loss = make_loss()
    assert {"_target_entropy", "_value_estimator.gamma"} <= set(loss.state_dict())
    assert loss.target_entropy == -2.0
    assert ("next", "action") not in loss.in_keys


def test_truncated_states_keep_their_value_and_terminal_ones_may_be_anything() -> None:
    td = make_data()
    td["next", "done"][:3] = True  # the first is terminated, the next two are truncated
    td["next", "velocity"][0] = torch.nan
    losses = []
    for data in (td, make_data()):
        loss = make_loss()
        torch.manual_seed(0)
        losses.append(loss(data)["loss_qvalue"])
    assert losses[0].isfinite()
    torch.testing.assert_close(losses[0], losses[1])
