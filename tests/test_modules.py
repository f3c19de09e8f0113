"""Networks of the worker."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec
from torchrl.envs import (
    TransformedEnv,
)

from torchrl_hmcts.modules import (
    ConcatSkillMLP,
    SkillActor,
    SkillCritic,
    SkillDiscriminator,
    SkillDynamics,
    SkillEncoder,
    SkillMLP,
    SkillPolicy,
    SpectralLinear,
)
from torchrl_hmcts.testing import PointMassEnv
from torchrl_hmcts.transforms import SkillTransform

NETWORKS = [SkillMLP, ConcatSkillMLP]


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


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_the_concatenated_skill_is_an_input_of_the_first_layer(batch: tuple[int, ...]) -> None:
    net = ConcatSkillMLP(2, 4, num_skills=3)
    x, skill = torch.randn(*batch, 2), torch.randint(3, batch)
    one_hot = torch.nn.functional.one_hot(skill, 3).float()
    by_hand = net.last(net.trunk(torch.cat((x, one_hot), -1)))
    torch.testing.assert_close(net(x, skill), by_hand)


@pytest.mark.parametrize("network", NETWORKS)
def test_all_skills_are_what_each_skill_gives_alone(network: type) -> None:
    net = network(3, 4, num_skills=3)
    x, y = torch.randn(2, 5, 2), torch.randn(2, 5, 1)
    alone = [net(x, y, torch.full((2, 5), z)) for z in range(3)]
    torch.testing.assert_close(net.all_skills(x, y), torch.stack(alone, -2))


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_stacked_parameters_give_each_copys_output(network: type, batch: tuple[int, ...]) -> None:
    nets = [network(2, 4, num_skills=3) for _ in range(2)]
    x, skill = torch.randn(*batch, 2), torch.randint(3, batch)
    expected = torch.stack([net(x, skill) for net in nets])
    stacked = TensorDict.from_modules(*nets, as_module=True)
    torch.testing.assert_close(nets[0].run(list(stacked.parameters()), x, skill), expected)
    with stacked.to_module(nets[0], preserve_module_state=False):
        both = nets[0](x, skill)
    torch.testing.assert_close(both, expected)
    assert nets[0].stackable
    assert not network(2, 4, 3, activation=torch.nn.PReLU).stackable


@pytest.mark.parametrize("hidden", [(), (8,), (8, 8)])
def test_a_discriminator_can_be_handed_its_weights(hidden: tuple[int, ...]) -> None:
    network = SkillDiscriminator(3, 4, in_keys=["velocity", "extra"], hidden=hidden).network
    x, y = torch.randn(2, 5, 2), torch.randn(2, 5, 1)
    torch.testing.assert_close(network.run(list(network.parameters()), x, y), network(x, y))


def test_a_spectral_layer_has_the_singular_value_one_before_and_after_training() -> None:
    layer = SpectralLinear(6, 4)

    def largest() -> float:
        return float(torch.linalg.matrix_norm(layer.normalized_weight().detach(), 2))

    assert largest() == pytest.approx(1.0, abs=1e-5)
    optimizer = torch.optim.SGD(layer.parameters(), lr=0.1)
    x, y = torch.randn(20, 6), torch.randn(20, 4)
    for _ in range(50):
        optimizer.zero_grad()
        (layer(x) - y).square().mean().backward()
        optimizer.step()
    assert largest() == pytest.approx(1.0, abs=0.1)  # one power iteration per step lags behind
    for _ in range(200):
        layer(x)
    assert largest() == pytest.approx(1.0, abs=1e-3)
    u = layer.u.clone()
    layer.eval()(x)
    with torch.no_grad():
        layer.train()(x)
    assert torch.equal(layer.u, u)


def test_a_spectral_encoder_never_stretches_a_distance() -> None:
    encoder = SkillEncoder(2, 4, linear=SpectralLinear)
    x, y = torch.randn(200, 2), torch.randn(200, 2)
    a, b = (encoder(TensorDict(position=p, batch_size=[200]))["representation"] for p in (x, y))
    assert ((a - b).norm(dim=-1) <= (x - y).norm(dim=-1) * (1 + 1e-4)).all()


def test_the_dynamics_predict_every_skills_change_with_a_bounded_deviation() -> None:
    dynamics = SkillDynamics(2, 3, 4, in_keys=["velocity"], target_key="x", std=0.5, min_std=0.2)
    td = dynamics(features(5))
    skill = torch.full((5,), 2)
    torch.testing.assert_close(td["skill_loc"][:, 2], dynamics.network(td["velocity"], skill))
    torch.testing.assert_close(td["skill_scale"], torch.full((5, 4, 3), 0.5))
    torch.nn.init.constant_(dynamics.log_std, -100.0)
    torch.testing.assert_close(dynamics(td)["skill_scale"], torch.full((5, 4, 3), 0.2))
    assert [n for n, _ in SkillDynamics(2, 3, 4, learned_std=False).named_buffers()] == ["log_std"]


def test_actor_and_critic_take_another_network_by_its_class() -> None:
    keys = {"in_keys": ["velocity"], "network": ConcatSkillMLP}
    actor = SkillActor(2, Categorical(4), num_skills=3, **keys)
    critic = SkillCritic(2, 4, num_skills=3, **keys)
    assert type(actor.network) is type(critic.network) is ConcatSkillMLP
    td = features(50)
    action = SkillPolicy(actor, deterministic=True)(td)["action"]
    assert torch.equal(action, actor.get_dist(td).probs.argmax(-1))


SPECS = [
    Categorical(4),
    OneHot(4),
    Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0])),
    Bounded(-1.0, 1.0, shape=(2,), dtype=torch.float64),  # the network's numbers are float32
]


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: type(spec).__name__)
def test_actor_and_policy_write_actions_of_the_spec(spec: TensorSpec) -> None:
    actor = SkillActor(3, spec, num_skills=3, in_keys=["velocity", "extra"])
    td = features(200)
    for module in (actor, SkillPolicy(actor), SkillPolicy(actor, deterministic=True)):
        action = module(td.clone())["action"]
        assert spec.expand(200, *spec.shape).is_in(action.to(spec.dtype))
        assert action.dtype == spec.dtype or isinstance(spec, OneHot)
    assert SkillPolicy(actor)(td)["action"].dtype == spec.dtype


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: type(spec).__name__)
def test_the_policy_shares_the_actors_parameters_and_takes_the_best(spec: TensorSpec) -> None:
    actor = SkillActor(2, spec, num_skills=3, in_keys=["velocity"])
    policy = SkillPolicy(actor, deterministic=True)
    assert {id(p) for p in policy.parameters()} == {id(p) for p in actor.parameters()}
    td = features(50)
    torch.nn.init.normal_(actor.network.heads.weight)
    action = policy(td.clone())["action"]
    assert not action.requires_grad
    best = actor.get_dist(td).deterministic_sample.detach()
    torch.testing.assert_close(action, best.to(action.dtype))
    if isinstance(spec, Bounded):
        loc = actor.module[0](td)["loc"].detach()
        middle, half_range = (spec.low + spec.high) / 2, (spec.high - spec.low) / 2
        torch.testing.assert_close(action, middle + half_range * loc.tanh())


def test_the_policy_samples_from_the_actors_distribution() -> None:
    actor = SkillActor(2, Categorical(4), num_skills=2, in_keys=["velocity"])
    torch.nn.init.normal_(actor.network.heads.bias)
    policy = SkillPolicy(actor, generator=torch.Generator().manual_seed(0))
    td = TensorDict(
        velocity=torch.zeros(20_000, 2),
        skill=torch.ones(20_000, dtype=torch.int64),
        batch_size=[20_000],
    )
    action = policy(td.clone())["action"]
    again = SkillPolicy(actor, generator=torch.Generator().manual_seed(0))(td)["action"]
    assert torch.equal(action, again)
    frequency = action.bincount(minlength=4) / 20_000
    torch.testing.assert_close(frequency, actor.get_dist(td[0]).probs, atol=0.02, rtol=0)


def test_a_batched_spec_has_the_bounds_of_one_action() -> None:
    env = TransformedEnv(PointMassEnv([3], continuous=True), SkillTransform(4, 50))
    actor = SkillActor(2, env.action_spec, 4, in_keys=["velocity"])
    assert actor.spec["action"].shape == (2,)
    data = env.rollout(2, SkillPolicy(actor))
    assert env.action_spec.unsqueeze(1).expand(3, 2, 2).is_in(data["action"])


def test_the_policy_samples_continuous_actions_from_the_actors_distribution() -> None:
    actor = SkillActor(2, SPECS[2], 4, in_keys=["velocity"])
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


def test_float64_observations_are_read_in_the_precision_of_the_networks() -> None:
    seen = torch.randn(5, 4, dtype=torch.float64)
    td = TensorDict(observation=seen, skill=torch.arange(5) % 3, batch_size=[5])
    keys: dict[str, Any] = {"in_keys": ["observation"]}
    for network in (
        SkillActor(4, Bounded(-1.0, 1.0, shape=(2,)), 3, **keys).module[0],
        SkillActor(4, Categorical(2), 3, network=ConcatSkillMLP, **keys).module[0],
        SkillDiscriminator(4, 3, **keys),
        SkillEncoder(4, 3, linear=SpectralLinear, **keys),
    ):
        with torch.no_grad():  # a spectral norm takes a step of its iteration with gradients
            double = network(td.clone())
            single = network(td.clone().set("observation", seen.float()))
        for key in network.out_keys:
            assert double[key].dtype == torch.float32
            assert double[key].equal(single[key]), key
    narrow = Bounded(-1.0, 1.0, shape=(2,), dtype=torch.float64)
    assert SkillPolicy(SkillActor(4, narrow, 3, **keys))(td)["action"].dtype == torch.float64


@pytest.mark.parametrize(
    ("features", "dtype", "message"),
    [
        (3, torch.float32, r"for 3 features of torch.float32 was given 4.*in_features=4"),
        (4, torch.int64, r"of torch.float32 was given 4 of torch.int64.*DTypeCastTransform"),
    ],
)
@pytest.mark.parametrize("kind", ["actor", "discriminator", "concatenated"])
def test_a_network_that_does_not_fit_what_it_reads_says_so(
    features: int, dtype: torch.dtype, message: str, kind: str
) -> None:
    keys = {"in_keys": ["observation"]}
    if kind == "discriminator":
        module: torch.nn.Module = SkillDiscriminator(features, num_skills=3, **keys)
    else:
        network = SkillMLP if kind == "actor" else ConcatSkillMLP
        module = SkillActor(features, Categorical(2), num_skills=3, network=network, **keys)
    given = 4 if features == 3 else features
    message = message if kind != "concatenated" else "was given"
    seen = torch.zeros(5, given, dtype=dtype)
    td = TensorDict(observation=seen, skill=torch.zeros(5, dtype=torch.int64))
    with pytest.raises(ValueError, match=message):
        module(td.auto_batch_size_(1))
