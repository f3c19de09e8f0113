"""Continuous actions: actor, policy, critic and SkillSACLoss."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import (
    Bounded,
    Categorical,
    LazyTensorStorage,
    ReplayBuffer,
)
from torchrl.envs import Compose, TransformedEnv
from torchrl.objectives import SACLoss, SoftUpdate
from torchrl.trainers.algorithms import SACTrainer

from torchrl_hmcts.modules import (
    ConcatSkillMLP,
    GaussianSkillActor,
    SkillActionCritic,
    SkillDiscriminator,
    SkillDynamics,
    SkillEncoder,
    SkillMLP,
    SkillPolicy,
    SpectralLinear,
)
from torchrl_hmcts.objectives import (
    ContinuousDIAYNLoss,
    LSDEncoderLoss,
    METRAEncoderLoss,
    SkillDiscriminatorLoss,
    SkillDynamicsLoss,
    SkillObjective,
    SkillSACLoss,
)
from torchrl_hmcts.testing import PointMassEnv
from torchrl_hmcts.transforms import DisplacementTransform, SkillReward, SkillTransform

OBJECTIVES = {
    "diayn": lambda: SkillDiscriminatorLoss(SkillDiscriminator(2, 4)),
    "metra": lambda: METRAEncoderLoss(SkillEncoder(2, 4)),
    "lsd": lambda: LSDEncoderLoss(SkillEncoder(2, 4, linear=SpectralLinear)),
    "dads": lambda: SkillDynamicsLoss(SkillDynamics(2, 2, 4)),
}
GROUPS = {
    "loss_actor": "actor_network_params.",
    "loss_qvalue": "qvalue_network_params.",
    "loss_alpha": "log_alpha",
    "loss_discriminator": "objective.",
}
SPEC = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0]), shape=(2,))


def make_env(copies: int = 16) -> TransformedEnv:
    return TransformedEnv(
        PointMassEnv([copies], continuous=True),
        Compose(SkillTransform(4, 50), DisplacementTransform()),
    )


def make_loss(
    objective: SkillObjective | None = None,
    *,
    network: Any = SkillMLP,
    seed: int = 0,
    spec: Bounded = SPEC,
    **kwargs: Any,
) -> SkillSACLoss:
    torch.manual_seed(seed)
    if objective is None:
        reduction = kwargs.pop("reduction", "mean")
        objective = SkillDiscriminatorLoss(SkillDiscriminator(2, 4), reduction=reduction)
    sizes = {"hidden": (8, 8), "activation": torch.nn.Tanh, "network": network}
    actor = GaussianSkillActor(2, spec, 4, in_keys=["velocity"], **sizes)
    critic = SkillActionCritic(4, 2, 4, in_keys=["velocity", "displacement"], **sizes)
    return SkillSACLoss(actor, critic, objective, **kwargs)


def make_data(n: int = 6, *, seed: int = 0) -> TensorDict:
    g = torch.Generator().manual_seed(seed)
    skill = torch.randint(4, (n,), generator=g)
    terminated = torch.arange(n)[:, None] == 0

    def state() -> dict[str, torch.Tensor]:
        return {
            "velocity": torch.randn(n, 2, generator=g),
            "displacement": torch.randn(n, 2, generator=g),
            "position": torch.randn(n, 2, generator=g),
            "skill": skill,
        }

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
    actor = GaussianSkillActor(2, SPEC, 4, in_keys=["velocity"])
    td = make_data(500)
    for policy in (actor, SkillPolicy(actor), SkillPolicy(actor, deterministic=True)):
        action = policy(td.copy())["action"]
        assert SPEC.expand(500, 2).is_in(action)
    assert not SkillPolicy(actor)(td)["action"].requires_grad


def test_a_batched_spec_has_the_bounds_of_one_action() -> None:
    env = make_env(3)
    actor = GaussianSkillActor(2, env.action_spec, 4, in_keys=["velocity"])
    assert actor.spec["action"].shape == (2,)
    data = env.rollout(2, SkillPolicy(actor))
    assert env.action_spec.unsqueeze(1).expand(3, 2, 2).is_in(data["action"])


def test_the_policy_shares_the_actors_parameters_and_takes_the_squashed_mean() -> None:
    actor = GaussianSkillActor(2, SPEC, 4, in_keys=["velocity"])
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
    actor = GaussianSkillActor(2, SPEC, 4, in_keys=["velocity"])
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


def test_nested_keys_are_read_and_written() -> None:
    td = TensorDict(agent=make_data(5).exclude("next", "action"), batch_size=[5])
    keys = {"in_keys": [("agent", "velocity")], "skill_key": ("agent", "skill")}
    actor = GaussianSkillActor(2, SPEC, 4, action_key=("agent", "action"), **keys)
    critic = SkillActionCritic(
        2, 2, 4, action_key=("agent", "action"), state_action_value_key=("agent", "q"), **keys
    )
    for policy in (actor, SkillPolicy(actor)):
        assert policy(td)["agent", "action"].shape == (5, 2)
    assert critic(td)["agent", "q"].shape == (5, 1)
    assert "loc" not in td.keys()


def test_bad_specs_are_refused_with_their_value() -> None:
    with pytest.raises(ValueError, match="Categorical.*SkillActor"):
        GaussianSkillActor(2, Categorical(4), 3, in_keys=["velocity"])
    with pytest.raises(ValueError, match="finite bounds.*inf"):
        GaussianSkillActor(2, Bounded(-1.0, float("inf"), shape=(1,)), 3, in_keys=["velocity"])
    with pytest.raises(ValueError, match=r"shape \(\)"):
        GaussianSkillActor(2, Bounded(-1.0, 1.0, shape=()), 3, in_keys=["velocity"])
    with pytest.raises(ValueError, match="action_features.*got 0"):
        SkillActionCritic(2, 0, 3, in_keys=["velocity"])


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


@pytest.mark.parametrize("name", GROUPS)
def test_each_loss_moves_only_its_own_parameters(name: str) -> None:
    loss = make_loss(fixed_alpha=False)
    loss(make_data())[name].backward()
    moved = [k for k, p in loss.named_parameters() if p.grad is not None and p.grad.any()]
    assert moved
    assert all(k.startswith(GROUPS[name]) for k in moved)


def test_mean_and_sum_are_those_of_the_unreduced_losses() -> None:
    outs = {}
    for reduction in ("none", "mean", "sum"):
        loss = make_loss(reduction=reduction)
        torch.manual_seed(3)
        outs[reduction] = loss(make_data())
    assert "alpha" not in outs["none"].keys()
    for key in (*GROUPS, "qvalue_loss_1"):
        assert outs["none"][key].shape == (6,)
        torch.testing.assert_close(outs["none"][key].mean(), outs["mean"][key])
        torch.testing.assert_close(outs["none"][key].sum(), outs["sum"][key])


def test_the_state_dict_round_trips_and_does_not_grow_on_use() -> None:
    first, second = make_loss(seed=0), make_loss(seed=1)
    before = set(first.state_dict())
    assert {"_target_entropy", "_value_estimator.gamma"} <= before
    first(make_data())
    assert set(first.state_dict()) == before
    second.load_state_dict(first.state_dict())
    outs = []
    for loss in (first, second):
        torch.manual_seed(3)
        outs.append(loss(make_data()).to_dict())
    torch.testing.assert_close(outs[0], outs[1])
    assert first.target_entropy == -2.0


def test_soft_updates_move_only_the_target_critics() -> None:
    loss = make_loss()
    updater = SoftUpdate(loss, tau=0.25)
    with torch.no_grad():
        for p in loss.qvalue_network_params.parameters():
            p += 1.0
    old = loss.target_qvalue_network_params.clone()
    updater.step()
    for key, new in loss.target_qvalue_network_params.items(True, True):
        torch.testing.assert_close(new, old[key] + 0.25)


def test_the_loss_takes_keyword_tensors_and_announces_its_outputs() -> None:
    loss, td = make_loss(), make_data()
    assert ("next", "action") not in loss.in_keys
    keywords = {"_".join(k) if isinstance(k, tuple) else k: td[k] for k in loss.in_keys}
    torch.manual_seed(3)
    by_name = dict(zip(loss.out_keys, loss(**keywords), strict=True))
    torch.manual_seed(3)
    out = loss(td)
    torch.testing.assert_close(by_name, out.to_dict())
    for key, value in out.items():
        assert value.requires_grad == (key.startswith("loss") and key != "loss_alpha")


def test_set_keys_moves_every_key_flat_or_nested() -> None:
    td = make_data()

    def run(loss: SkillSACLoss, data: TensorDict) -> dict[str, Any]:
        torch.manual_seed(3)
        return loss(data).to_dict()

    expected = run(make_loss(), td.clone())
    torch.manual_seed(0)
    discriminator = SkillDiscriminator(
        2, 4, in_keys=[("agent", "d")], skill_logits_key=("agent", "guess")
    )
    sizes = {"hidden": (8, 8), "activation": torch.nn.Tanh, "skill_key": ("agent", "z")}
    keys = [("agent", "v"), ("agent", "d")]
    action = {"action_key": ("agent", "action")}
    actor = GaussianSkillActor(2, SPEC, 4, in_keys=keys[:1], **action, **sizes)
    critic = SkillActionCritic(
        4, 2, 4, in_keys=keys, state_action_value_key=("agent", "q"), **action, **sizes
    )
    loss = ContinuousDIAYNLoss(actor, critic, discriminator)
    loss.set_keys(
        action=("agent", "action"),
        state_action_value=("agent", "q"),
        skill=("agent", "z"),
        skill_logits=("agent", "guess"),
        reward="intrinsic",
    )
    names = {"velocity": "v", "displacement": "d", "skill": "z", "action": "action"}
    after = td.pop("next")
    moved = TensorDict(
        {
            "agent": {new: td[old] for old, new in names.items()},
            "next": {
                "agent": {names[k]: after[k] for k in ("velocity", "displacement", "skill")},
                "intrinsic": after["reward"],
                "done": after["done"],
                "terminated": after["terminated"],
            },
        },
        batch_size=[6],
    )
    moved["next"].batch_size = [6]
    assert set(loss.in_keys) <= set(moved.keys(True, True))
    torch.testing.assert_close(run(loss, moved), expected)


def test_continuous_diayn_is_the_loss_with_a_discriminator() -> None:
    expected = make_loss()
    torch.manual_seed(0)
    discriminator = SkillDiscriminator(2, 4)
    sizes = {"hidden": (8, 8), "activation": torch.nn.Tanh}
    loss = ContinuousDIAYNLoss(
        GaussianSkillActor(2, SPEC, 4, in_keys=["velocity"], **sizes),
        SkillActionCritic(4, 2, 4, in_keys=["velocity", "displacement"], **sizes),
        discriminator,
        gamma=0.95,
    )
    assert loss.discriminator is discriminator
    outs = []
    for each in (expected, loss):
        torch.manual_seed(3)
        outs.append(each(make_data()).to_dict())
    torch.testing.assert_close(outs[0], outs[1])
    with pytest.raises(ValueError, match=r"ContinuousDIAYNLoss.*gamma.*1\.5"):
        ContinuousDIAYNLoss(loss.actor_network, loss.qvalue_network, discriminator, gamma=1.5)


@pytest.mark.filterwarnings("ignore:SACTrainer is an experimental:UserWarning")
@pytest.mark.filterwarnings("ignore:The 'post_loss' hook stage:FutureWarning")
@pytest.mark.filterwarnings("ignore:The 'optimizer' hook stage:FutureWarning")
@pytest.mark.parametrize("network", [SkillMLP, ConcatSkillMLP])
@pytest.mark.parametrize("name", OBJECTIVES)
def test_torchrls_sac_trainer_runs_with_another_objective_by_changing_one_object(
    name: str, network: type
) -> None:
    env = make_env(16)
    loss = make_loss(OBJECTIVES[name](), network=network, spec=env.action_spec)  # the one object
    collector = Collector(
        env,
        loss.actor_network,
        frames_per_batch=64,
        total_frames=192,
        auto_register_policy_transforms=False,
    )
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(1000), transform=SkillReward(loss.objective), batch_size=32
    )
    before = [p.detach().clone() for p in loss.parameters()]
    SACTrainer(
        collector=collector,
        total_frames=192,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters()),
        replay_buffer=buffer,
        batch_size=32,
        target_net_updater=SoftUpdate(loss, tau=0.05),
        progress_bar=False,
        enable_logging=False,
    ).train()
    after = loss.named_parameters()
    still = [k for (k, p), old in zip(after, before, strict=True) if torch.equal(p, old)]
    assert still in ([], ["objective.encoder_params.network.4.bias"])  # phi(s') - phi(s) has none


def test_skipping_done_states_leaves_truncated_ones_their_value() -> None:
    td = make_data()
    td["next", "done"][:3] = True  # the first is terminated, the next two are truncated
    td["next", "velocity"][0] = torch.nan
    losses = []
    for skip, data in ((True, td), (False, make_data())):
        loss = make_loss(skip_done_states=skip)
        torch.manual_seed(0)
        losses.append(loss(data.clone())["loss_qvalue"])
    assert losses[0].isfinite()
    torch.testing.assert_close(losses[0], losses[1])
