"""METRA, LSD and DADS beside DIAYN: rewards, losses, priors, and swapping one for another.

What they share with all losses (keys, reductions, gradients, ...) is in test_contract_losses.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import Categorical, LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.objectives import SoftUpdate
from torchrl.record.loggers.tensorboard import TensorboardLogger
from torchrl.trainers.algorithms import SACTrainer

from torchrl_hmcts.modules import (
    FixedSkillPrior,
    GrowingSkillPrior,
    SkillActionCritic,
    SkillActor,
    SkillCritic,
    SkillDiscriminator,
    SkillDynamics,
    SkillEncoder,
    SkillPolicy,
    SpectralLinear,
)
from torchrl_hmcts.modules.skill_mlp import SkillNetwork
from torchrl_hmcts.objectives import (
    DiscreteSkillSACLoss,
    LSDEncoderLoss,
    METRAEncoderLoss,
    SkillDiscriminatorLoss,
    SkillDynamicsLoss,
    SkillObjective,
    SkillSACLoss,
)
from torchrl_hmcts.testing import PointMassEnv
from torchrl_hmcts.trainers import DIAYNTrainer
from torchrl_hmcts.transforms import DisplacementTransform, SkillReward, SkillTransform

LOSSES = {
    "diayn": ["loss_discriminator"],
    "metra": ["loss_encoder", "loss_dual"],
    "lsd": ["loss_encoder"],
    "dads": ["loss_dynamics"],
}


def make_objective(name: str, num_skills: int = 3, **kwargs: Any) -> SkillObjective:
    """Returns an objective with small smooth networks that read one entry of two numbers."""
    torch.manual_seed(0)
    sizes: dict[str, Any] = {"in_keys": ["position"], "hidden": (8,), "activation": torch.nn.Tanh}
    if name == "diayn":
        return SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills, **sizes), **kwargs)
    if name == "metra":
        return METRAEncoderLoss(SkillEncoder(2, num_skills, **sizes), **kwargs)
    if name == "lsd":
        return LSDEncoderLoss(SkillEncoder(2, num_skills, linear=SpectralLinear, **sizes), **kwargs)
    return SkillDynamicsLoss(SkillDynamics(2, 2, num_skills, **sizes), **kwargs)


def make_data(n: int = 6) -> TensorDict:
    g = torch.Generator().manual_seed(0)
    position = torch.randn(n, 2, generator=g)
    after = {"position": position + torch.randn(n, 2, generator=g)}
    return TensorDict(
        position=position,
        skill=torch.randint(3, (n,), generator=g),
        next=TensorDict(after, batch_size=[n]),
        batch_size=[n],
    )


def identity_encoder(size: int) -> SkillNetwork:
    """Returns an encoder phi(x) = x."""
    encoder = SkillNetwork(torch.nn.Identity(), ["x"], "representation")
    encoder.num_skills = size
    return encoder


def steps(*rows: tuple[float, ...], skills: Sequence[int]) -> TensorDict:
    """Returns transitions with the given steps of x, from an arbitrary point."""
    change = torch.tensor(rows)
    root = torch.full_like(change, 0.3)
    after = TensorDict(x=root + change, batch_size=[len(rows)])
    return TensorDict(x=root, skill=torch.tensor(skills), next=after, batch_size=[len(rows)])


def test_the_vectors_of_the_skills_are_those_of_the_papers_and_centred_under_any_prior() -> None:
    vectors = METRAEncoderLoss(identity_encoder(4)).skill_vectors()
    third = -1.0 / 3.0
    torch.testing.assert_close(vectors, torch.eye(4) * (1.0 - third) + third)
    prior = torch.tensor([0.5, 0.3, 0.2, 0.0])
    vectors = METRAEncoderLoss(identity_encoder(4), prior=prior).skill_vectors()
    torch.testing.assert_close(prior @ vectors, torch.zeros(4))
    assert METRAEncoderLoss(identity_encoder(1)).skill_vectors().item() == 0.0


def test_metra_has_its_closed_form() -> None:
    # Vectors of three skills: 1 at the skill, -1/2 elsewhere.
    td = steps((0.6, 0.0, 0.2), (1.0, 1.0, 0.0), skills=[0, 2])
    objective = METRAEncoderLoss(identity_encoder(3), dual_init=2.0, slack=0.25, reduction="none")
    travel = [0.6 - 0.1, -1.0]
    torch.testing.assert_close(objective.reward(td), torch.tensor(travel)[:, None])
    out = objective(td)
    # ||step||^2 is 0.4 and 2: the first leaves 0.6, which counts as the slack of 0.25.
    room = [0.25, -1.0]
    expected = torch.tensor([-(t + 2.0 * c) for t, c in zip(travel, room, strict=True)])
    torch.testing.assert_close(out["loss_encoder"], expected)
    torch.testing.assert_close(out["loss_dual"], math.log(2.0) * torch.tensor(room))
    torch.testing.assert_close(out["latent_distance"], torch.tensor([0.4, 2.0]).sqrt())
    torch.testing.assert_close(out["dual"], torch.tensor([2.0, 2.0]))


def test_metras_dual_rises_when_steps_are_too_long_and_falls_when_they_are_not() -> None:
    for step, sign in ((2.0, -1.0), (0.1, 1.0)):
        objective = METRAEncoderLoss(identity_encoder(2))
        objective(steps((step, 0.0), skills=[0]))["loss_dual"].backward()
        assert torch.sign(objective.log_dual.grad) == sign  # descent moves against the gradient


def test_lsd_has_its_closed_form() -> None:
    td = steps((0.6, 0.0, 0.8), skills=[1])
    objective = LSDEncoderLoss(identity_encoder(3))
    torch.testing.assert_close(objective.reward(td), torch.tensor([[-0.7]]))
    out = objective(td)
    torch.testing.assert_close(out["loss_encoder"], torch.tensor(0.7))
    torch.testing.assert_close(out["latent_distance"], torch.tensor(1.0))


def test_lsd_refuses_an_encoder_that_can_stretch_distances() -> None:
    with pytest.raises(ValueError, match=r"network\.0.*SpectralLinear"):
        LSDEncoderLoss(SkillEncoder(2, 3))
    encoder = SkillEncoder(2, 3)
    for layer in list(encoder.network):
        if isinstance(layer, torch.nn.Linear):
            torch.nn.utils.parametrizations.spectral_norm(layer)
    LSDEncoderLoss(encoder)


def test_dads_has_its_closed_form() -> None:
    dynamics = SkillDynamics(1, 1, 2, in_keys=["x"], target_key="x", std=0.5, learned_std=False)
    for p in dynamics.parameters():
        torch.nn.init.zeros_(p)
    with torch.no_grad():
        dynamics.network.heads.bias.copy_(torch.tensor([1.0, 0.0]))  # skill 0 moves by 1
    td = steps((1.0,), (0.5,), (0.0,), skills=[0, 0, 0])
    objective = SkillDynamicsLoss(dynamics, reduction="none")

    def density(x: float, mean: float) -> float:
        return math.exp(-0.5 * ((x - mean) / 0.5) ** 2) / (0.5 * math.sqrt(2.0 * math.pi))

    changes = (1.0, 0.5, 0.0)
    loss = torch.tensor([-math.log(density(x, 1.0)) for x in changes])
    torch.testing.assert_close(objective(td)["loss_dynamics"], loss)
    for prior in (None, [0.25, 0.75]):
        p = [0.5, 0.5] if prior is None else prior
        reward = [
            math.log(density(x, 1.0) / (p[0] * density(x, 1.0) + p[1] * density(x, 0.0)))
            for x in changes
        ]
        out = SkillDynamicsLoss(dynamics, prior=prior).reward(td)
        torch.testing.assert_close(out, torch.tensor(reward)[:, None])
    # With the change of 1 skill 0 is the more probable one; with none, skill 1.
    assert objective(td[[0, 2]])["dynamics_accuracy"].tolist() == [1.0, 0.0]


def test_dads_learns_the_standard_deviation_of_the_changes() -> None:
    dynamics = SkillDynamics(2, 2, 3, std=1.0)
    objective = SkillDynamicsLoss(dynamics)
    optimizer = torch.optim.Adam(objective.parameters(), lr=0.05)
    td = make_data(256)
    td["next", "position"] = td["position"] + 0.05 * torch.randn(256, 2)
    for _ in range(120):
        optimizer.zero_grad()
        objective(td)["loss_dynamics"].backward()
        optimizer.step()
    scale = dynamics(td.copy())["skill_scale"]
    torch.testing.assert_close(scale.mean(), torch.tensor(0.05), atol=0.01, rtol=0)


@pytest.mark.parametrize("name", LOSSES)
def test_skills_that_are_switched_off_count_for_nothing(name: str) -> None:
    prior = GrowingSkillPrior(3, num_active=2)
    objective = make_objective(name, prior=prior)
    td = make_data(60)
    on = td["skill"] < 2
    reward = objective.reward(td)
    assert torch.isfinite(reward).all()
    assert not reward[~on].any()
    out = objective(td)
    sum(out[key] for key in LOSSES[name]).backward()
    assert all(torch.isfinite(p.grad).all() for p in objective.parameters() if p.grad is not None)
    if name != "metra":  # whose constraint holds on all transitions
        none = make_objective(name, prior=prior, reduction="none")(td)
        assert not any(none[key][~on].any() for key in LOSSES[name])
    if name in ("diayn", "dads"):
        # Two skills that cannot be told apart are worth nothing; with log 3 they would be.
        assert reward.max() <= math.log(2.0) + 1e-6
    assert "prior" not in "".join(objective.state_dict())
    prior.set_num_active(3)  # read live
    assert objective.reward(td)[~on].any()


@pytest.mark.parametrize("prior", [None, [0.5, 0.5, 0.0]])
@pytest.mark.parametrize("name", LOSSES)
def test_transitions_may_be_on_another_device_than_the_prior(name: str, prior: Any) -> None:
    # The device "meta" holds no numbers, and refuses to be mixed with the CPU as a GPU does.
    torch.manual_seed(0)
    network: Any = {
        "diayn": lambda: SkillDiscriminator(2, 3, in_keys=["position"]),
        "dads": lambda: SkillDynamics(2, 2, 3),
        "lsd": lambda: SkillEncoder(2, 3, linear=SpectralLinear),
        "metra": lambda: SkillEncoder(2, 3),
    }[name]()
    made = type(make_objective(name))(network.to("meta"), prior=prior)
    if name == "metra":
        made.log_dual = torch.nn.Parameter(made.log_dual.detach().to("meta"))
    data = make_data().to("meta")
    assert made.finite_reward(data).device.type == "meta"
    assert all(made(data).get(key).device.type == "meta" for key in LOSSES[name])


def test_a_discriminator_shares_all_its_belief_among_the_skills_that_are_on() -> None:
    td = make_data()
    td["skill"].zero_()
    net = make_objective("diayn").discriminator
    masked = SkillDiscriminatorLoss(net, prior=[0.5, 0.5, 0.0], reduction="none")
    logits = masked.discriminator(td["next"].copy())["skill_logits"]
    expected = -logits[:, :2].log_softmax(-1)[:, 0]
    torch.testing.assert_close(masked(td)["loss_discriminator"], expected)
    torch.testing.assert_close(masked.reward(td).squeeze(-1), math.log(2.0) - expected)


def test_a_prior_is_a_sequence_or_an_object_of_the_right_size() -> None:
    td = make_data()
    by_sequence = make_objective("diayn", prior=[2.0, 1.0, 1.0]).reward(td)
    by_object = make_objective("diayn", prior=FixedSkillPrior(3, [2.0, 1.0, 1.0])).reward(td)
    torch.testing.assert_close(by_sequence, by_object)
    with pytest.raises(ValueError, match="3 skills.*over 4"):
        make_objective("diayn", prior=FixedSkillPrior(4))
    with pytest.raises(ValueError, match="num_skills="):
        METRAEncoderLoss(SkillNetwork(torch.nn.Identity(), ["x"], "representation"))
    with pytest.raises(ValueError, match="made for 5 skills.*3 skills"):
        METRAEncoderLoss(SkillEncoder(2, 3), num_skills=5)
    with pytest.raises(AttributeError, match="target_key"):
        SkillDynamicsLoss(identity_encoder(3))


# The reward transform


@pytest.mark.parametrize("name", LOSSES)
def test_a_replay_buffer_scores_with_the_objective_of_today(name: str) -> None:
    objective = make_objective(name)
    transform = SkillReward(objective, intrinsic_coeff=2.0)
    buffer = ReplayBuffer(storage=LazyTensorStorage(6), transform=transform, batch_size=20)
    buffer.extend(make_data())
    for _ in range(2):
        sample = buffer.sample()
        expected = objective.reward(sample.exclude(("next", "reward")))
        torch.testing.assert_close(sample["next", "reward"], 2.0 * expected)
        with torch.no_grad():
            for p in objective.parameters():
                p.add_(0.1)
    assert list(transform.parameters()) == []
    assert not transform.state_dict()


def test_the_reward_of_the_env_is_mixed_in_on_request() -> None:
    objective, td = make_objective("metra"), make_data()
    td["next", "reward"] = torch.ones(6, 1)
    out = SkillReward(objective, extrinsic_coeff=3.0)(td.clone())
    torch.testing.assert_close(out["next", "reward"], objective.reward(td) + 3.0)
    out = SkillReward(objective, reward_key=("agent", "bonus"))(td.clone())
    torch.testing.assert_close(out["next", "agent", "bonus"], objective.reward(td))
    assert out["next", "reward"].eq(1.0).all()
    with pytest.raises(KeyError, match="SkillReward.*extrinsic_coeff=3"):
        SkillReward(objective, extrinsic_coeff=3.0)(make_data())


@pytest.mark.parametrize("name", LOSSES)
def test_an_env_scores_each_step(name: str) -> None:
    env = make_env(5)
    objective = make_objective(name, num_skills=4)
    env.append_transform(SkillReward(objective))
    check_env_specs(env)
    data = env.rollout(3)
    torch.testing.assert_close(data["next", "reward"], objective.reward(data), atol=1e-6, rtol=1e-5)


# Swapping


def make_env(copies: int = 16, continuous: bool = False) -> TransformedEnv:
    return TransformedEnv(
        PointMassEnv([copies], continuous=continuous),
        Compose(SkillTransform(4, 50), DisplacementTransform()),
    )


def make_loss(objective: SkillObjective, **kwargs: Any) -> DiscreteSkillSACLoss:
    torch.manual_seed(0)
    actor = SkillActor(2, Categorical(4), 4, in_keys=["velocity"])
    critic = SkillCritic(4, 4, 4, in_keys=["velocity", "displacement"])
    return DiscreteSkillSACLoss(actor, critic, objective, action_space="categorical", **kwargs)


def make_transitions() -> TensorDictBase:
    td = make_env(6).rollout(1).reshape(-1).set("action", torch.arange(6) % 4)
    td["next", "reward"] = torch.randn(6, 1)
    return td


def test_the_td_error_is_the_larger_of_both_critics_distances_to_the_target() -> None:
    loss, td = make_loss(make_objective("diayn", num_skills=4)), make_transitions()
    SoftUpdate(loss, tau=0.05)
    values = loss._critics(td, loss.qvalue_network_params)  # [2, 6, 4]
    _, metadata = loss._qvalue_loss(values, td)
    distances = (values[:, torch.arange(6), td["action"]] - loss._compute_target(td)).abs()
    torch.testing.assert_close(metadata["td_error"], distances.amax(0).detach())
    for i in range(2):
        torch.testing.assert_close(
            metadata[f"qvalue_loss_{i}"], distances[i].square().mean().detach()
        )


def make_prior(logits: list[float]) -> TensorDictModule:
    """Returns a policy that does not look at anything."""
    row = torch.tensor(logits)
    return TensorDictModule(lambda z: row.expand(*z.shape, 4), ["skill"], ["logits"])


def test_a_uniform_policy_prior_is_the_entropy_up_to_a_constant() -> None:
    td, losses = make_transitions(), []
    for prior in (None, make_prior([0.0] * 4)):
        objective = make_objective("diayn", num_skills=4)
        losses.append(make_loss(objective, alpha_init=0.2, gamma=0.9, policy_prior=prior))
        SoftUpdate(losses[-1], tau=0.05)
    plain, kept = losses
    torch.testing.assert_close(
        kept(td)["loss_actor"], plain(td)["loss_actor"] + 0.2 * math.log(4), atol=1e-5, rtol=0
    )
    # The target loses gamma * alpha * log 4 where the episode continues.
    difference = plain._compute_target(td) - kept._compute_target(td)
    expected = ~td["next", "terminated"].flatten() * 0.9 * 0.2 * math.log(4)
    torch.testing.assert_close(difference, expected, atol=1e-5, rtol=0)


def test_the_best_policy_is_the_prior_times_the_exponential_of_the_values() -> None:
    prior = [0.0, 1.0, -1.0, 0.5]
    objective = make_objective("diayn", num_skills=4)
    loss = make_loss(objective, alpha_init=0.5, policy_prior=make_prior(prior))
    td = TensorDict(skill=torch.zeros(1, dtype=torch.int64), batch_size=[1])
    values = torch.tensor([[0.3, -0.2, 0.9, 0.1]])
    best = (torch.tensor(prior) + values / 0.5).log_softmax(-1)
    theta = best.clone().requires_grad_()
    loss._log_probs = lambda td: theta.log_softmax(-1)
    found, _ = loss._actor_loss(values, td)
    found.backward()
    torch.testing.assert_close(theta.grad, torch.zeros(1, 4), atol=1e-6, rtol=0)
    # Its value is minus alpha times the logarithm of the partition function.
    partition = (torch.tensor(prior).softmax(-1) * (values / 0.5).exp()).sum()
    torch.testing.assert_close(found, -0.5 * partition.log())


def test_a_policy_prior_is_neither_trained_nor_saved_and_must_write_logits() -> None:
    network = TensorDictModule(torch.nn.Linear(2, 4), ["velocity"], ["logits"])
    loss = make_loss(make_objective("diayn", num_skills=4), policy_prior=network)
    SoftUpdate(loss, tau=0.05)
    out = loss(make_transitions())
    sum(v for k, v in out.items() if k.startswith("loss")).backward()
    assert all(p.grad is None for p in network.parameters())
    plain = make_loss(make_objective("diayn", num_skills=4))
    assert loss.state_dict().keys() == plain.state_dict().keys()
    wrong = TensorDictModule(torch.nn.Linear(2, 4), ["velocity"], ["action"])
    with pytest.raises(ValueError, match="'logits' of its policy_prior"):
        make_loss(make_objective("diayn", num_skills=4), policy_prior=wrong)


@pytest.mark.filterwarnings("ignore:SACTrainer is an experimental:UserWarning")
@pytest.mark.filterwarnings("ignore:The 'post_loss' hook stage:FutureWarning")
@pytest.mark.filterwarnings("ignore:The 'optimizer' hook stage:FutureWarning")
@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize("name", LOSSES)
def test_torchrls_sac_trainer_runs_with_another_objective_by_changing_one_object(
    name: str, continuous: bool, tmp_path: Path
) -> None:
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    objective = make_objective(name, num_skills=4)  # the one object
    env = make_env(16, continuous)
    env.append_transform(RewardSum(["reward"], ["reward_sum"]))  # what SACTrainer logs
    loss: Any = make_loss(objective)
    if continuous:
        actor = SkillActor(2, env.action_spec, 4, in_keys=["velocity"])
        critic = SkillActionCritic(4, 2, 4, in_keys=["velocity", "displacement"])
        loss = SkillSACLoss(actor, critic, objective)
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
        logger=TensorboardLogger("run", tmp_path),
        log_interval=1,
    ).train()
    (events,) = tmp_path.rglob("events*")
    logged = accumulator.EventAccumulator(str(events)).Reload().Tags()["scalars"]
    assert {"r_training", "loss_actor", "loss_qvalue", *LOSSES[name]} <= set(logged)
    now = loss.named_parameters()
    still = [k for (k, p), old in zip(now, before, strict=True) if torch.equal(p, old)]
    assert still in ([], ["objective.encoder_params.network.2.bias"])  # phi(s') - phi(s) has none


def test_the_loss_hands_its_skill_key_and_reduction_down_and_takes_them_over() -> None:
    objective = make_objective("metra", num_skills=4, reduction="sum")
    objective.set_keys(skill="z")
    loss = make_loss(objective)
    assert loss.tensor_keys.skill == "z"
    assert loss.reduction == "sum"
    loss.set_keys(skill=("agent", "z"))
    assert objective.in_keys[0] == ("agent", "z")
    assert ("agent", "z") in loss.in_keys
    with pytest.raises(ValueError, match="'mean'.*'sum'"):
        make_loss(objective, reduction="mean")
    with pytest.raises(TypeError, match="SkillDiscriminator"):
        make_loss(SkillDiscriminator(2, 4))


@torch.no_grad()
def displacements(loss: DiscreteSkillSACLoss, per_skill: int = 64) -> torch.Tensor:
    """Returns the skills' mean displacements ``[4, 2]`` after 50 steps."""
    env, policy = make_env(4 * per_skill), SkillPolicy(loss.actor_network)
    env.set_seed(123)
    skill = torch.arange(4).repeat_interleave(per_skill)
    td = env.reset(TensorDict(skill=skill, batch_size=[4 * per_skill]))
    end = env.rollout(50, policy, auto_reset=False, tensordict=td)[:, -1]["next"]
    return end["displacement"].view(4, per_skill, 2).mean(1)


def test_metra_makes_skills_travel_apart_within_a_short_run() -> None:
    torch.manual_seed(0)
    loss = make_loss(METRAEncoderLoss(SkillEncoder(2, 4)))
    before = displacements(loss)
    DIAYNTrainer(
        make_env(32),
        loss,
        total_frames=6_400,
        updates_per_batch=2,
        batch_size=128,
        reward=SkillReward(loss.objective, intrinsic_coeff=2.0),
        seed=0,
    ).train()
    after = displacements(loss)
    spread = (after - after.mean(0)).norm(dim=-1).mean()
    assert spread > 3.0 * (before - before.mean(0)).norm(dim=-1).mean()
    assert spread > 1.0
