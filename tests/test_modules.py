"""Networks of the worker."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot

from torchrl_hmcts.modules import (
    SkillActor,
    SkillCritic,
    SkillDiscriminator,
    SkillMLP,
    SkillPolicy,
)


def features(*batch: int, skills: int = 3) -> TensorDict:
    return TensorDict(
        velocity=torch.randn(*batch, 2),
        extra=torch.randn(*batch, 1),
        skill=torch.randint(skills, batch),
        batch_size=batch,
    )


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_the_mlp_uses_the_head_of_each_elements_skill(batch: tuple[int, ...]) -> None:
    net = SkillMLP(2, 4, num_skills=3)
    x, skill = torch.randn(*batch, 2), torch.randint(3, batch)
    weight, bias = net.heads.weight.view(3, 4, 64), net.heads.bias.view(3, 4)
    by_hand = (weight[skill] @ net.trunk(x).unsqueeze(-1)).squeeze(-1) + bias[skill]
    torch.testing.assert_close(net(x, skill), by_hand)


def test_a_gradient_reaches_only_the_head_that_was_used() -> None:
    net = SkillMLP(2, 1, num_skills=3)
    net(torch.randn(4, 2), torch.full((4,), 1)).sum().backward()
    used = net.heads.weight.grad.abs().sum(-1) > 0
    assert used.tolist() == [False, True, False]


def test_stacked_parameters_give_each_copys_output() -> None:
    nets = [SkillMLP(2, 4, num_skills=3) for _ in range(2)]
    x, skill = torch.randn(5, 2), torch.randint(3, (5,))
    stacked = TensorDict.from_modules(*nets, as_module=True)
    with stacked.to_module(nets[0], preserve_module_state=False):
        both = nets[0](x, skill)
    torch.testing.assert_close(both, torch.stack([net(x, skill) for net in nets]))
    assert nets[0].stackable
    assert not SkillMLP(2, 4, 3, activation=torch.nn.PReLU).stackable


def test_the_mlp_can_be_vmapped_over_parameters() -> None:
    nets = [SkillMLP(2, 4, num_skills=3) for _ in range(2)]
    x, skill = torch.randn(5, 2), torch.randint(3, (5,))
    params, _ = torch.func.stack_module_state(nets)
    out = torch.vmap(lambda p: torch.func.functional_call(nets[0], p, (x, skill)))(params)
    torch.testing.assert_close(out, torch.stack([net(x, skill) for net in nets]))


@pytest.mark.parametrize("spec", [Categorical(4), OneHot(4)], ids=["categorical", "one-hot"])
@pytest.mark.parametrize("deterministic", [True, False])
def test_actor_and_policy_write_actions_of_the_spec(spec: object, deterministic: bool) -> None:
    actor = SkillActor(3, spec, num_skills=3, in_keys=["velocity", "extra"])
    td = features(6)
    for module in (actor, SkillPolicy(actor, deterministic=deterministic)):
        action = module(td.clone())["action"].to(spec.dtype)
        assert spec.expand(6, *spec.shape).is_in(action)
    assert SkillPolicy(actor)(td)["action"].dtype == spec.dtype


def test_the_policy_shares_the_actors_parameters_and_takes_the_mode() -> None:
    actor = SkillActor(2, Categorical(4), num_skills=3, in_keys=["velocity"])
    policy = SkillPolicy(actor, deterministic=True)
    assert {id(p) for p in policy.parameters()} == {id(p) for p in actor.parameters()}
    td = features(50)
    torch.nn.init.normal_(actor.network.heads.weight)
    mode = actor.get_dist(td.clone()).probs.argmax(-1)
    action = policy(td)["action"]
    assert torch.equal(action, mode)
    assert not action.requires_grad


def test_the_policy_samples_from_the_actors_distribution() -> None:
    actor = SkillActor(2, Categorical(4), num_skills=2, in_keys=["velocity"])
    torch.nn.init.normal_(actor.network.heads.bias)
    policy = SkillPolicy(actor, generator=torch.Generator().manual_seed(0))
    td = TensorDict(
        velocity=torch.zeros(20_000, 2),
        skill=torch.ones(20_000, dtype=torch.int64),
        batch_size=[20_000],
    )
    frequency = policy(td)["action"].bincount(minlength=4) / 20_000
    torch.testing.assert_close(frequency, actor.get_dist(td[0]).probs, atol=0.02, rtol=0)


def test_the_same_generator_seed_gives_the_same_actions() -> None:
    actor = SkillActor(2, Categorical(4), num_skills=3, in_keys=["velocity"])
    td = features(40)
    first, second = (
        SkillPolicy(actor, generator=torch.Generator().manual_seed(1))(td.clone())["action"]
        for _ in range(2)
    )
    assert torch.equal(first, second)


def test_nested_keys_are_read_and_written() -> None:
    td = TensorDict(agent=features(5), batch_size=[5])
    keys = {"in_keys": [("agent", "velocity")], "skill_key": ("agent", "skill")}
    actor = SkillActor(2, Categorical(4), 3, action_key=("agent", "action"), **keys)
    critic = SkillCritic(2, 4, 3, action_value_key=("agent", "action_value"), **keys)
    discriminator = SkillDiscriminator(
        2, 3, in_keys=[("agent", "velocity")], skill_logits_key=("agent", "skill_logits")
    )
    for module in (actor, SkillPolicy(actor), critic, discriminator):
        module(td)
    assert td["agent", "action"].shape == (5,)
    assert td["agent", "action_value"].shape == (5, 4)
    assert td["agent", "skill_logits"].shape == (5, 3)


@pytest.mark.parametrize("hidden", [(), (8,)])
def test_the_discriminator_concatenates_its_features(hidden: tuple[int, ...]) -> None:
    net = SkillDiscriminator(3, 4, in_keys=["velocity", "extra"], hidden=hidden)
    assert net(features(5))["skill_logits"].shape == (5, 4)


def test_bad_arguments_are_refused_with_their_value() -> None:
    with pytest.raises(ValueError, match="num_skills.*got 0"):
        SkillMLP(2, 4, num_skills=0)
    with pytest.raises(ValueError, match=r"shared layer.*hidden=\(\)"):
        SkillMLP(2, 4, 3, hidden=())
    with pytest.raises(ValueError, match=r"hidden=\(64, 0\)"):
        SkillMLP(2, 4, 3, hidden=(64, 0))
    with pytest.raises(ValueError, match="Bounded"):
        SkillActor(2, Bounded(-1, 1, shape=(1,)), 3, in_keys=["velocity"])
    with pytest.raises(ValueError, match="in_key"):
        SkillCritic(2, 4, 3, in_keys=[])
    with pytest.raises(TypeError, match="Linear"):
        SkillPolicy(torch.nn.Linear(2, 2))
