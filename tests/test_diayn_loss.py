"""DIAYNLoss and the discriminator's loss."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical, OneHot
from torchrl.objectives import DiscreteSACLoss, SoftUpdate

from torchrl_hmcts.modules import ConcatSkillMLP, SkillActor, SkillCritic, SkillDiscriminator
from torchrl_hmcts.objectives import DIAYNLoss, SkillDiscriminatorLoss
from torchrl_hmcts.transforms import SkillReward

GROUPS = {
    "loss_actor": "actor_network_params",
    "loss_qvalue": "qvalue_network_params",
    "loss_discriminator": "discriminator_params",
}


def make_loss(*, one_hot: bool = False, seed: int = 0, **kwargs: Any) -> DIAYNLoss:
    torch.manual_seed(seed)
    spec = OneHot(4) if one_hot else Categorical(4)
    sizes = {"hidden": (8, 8), "activation": torch.nn.Tanh}
    actor = SkillActor(2, spec, 3, in_keys=["velocity"], **sizes)
    critic = SkillCritic(4, 4, 3, in_keys=["velocity", "displacement"], **sizes)
    return DIAYNLoss(actor, critic, SkillDiscriminator(2, 3), action_space=spec, **kwargs)


def make_data(n: int = 6, *, one_hot: bool = False, seed: int = 0) -> TensorDict:
    g = torch.Generator().manual_seed(seed)
    skill = torch.randint(3, (n,), generator=g)
    action = torch.randint(4, (n,), generator=g)
    terminated = torch.arange(n)[:, None] == 0

    def state() -> dict[str, torch.Tensor]:
        return {
            "velocity": torch.randn(n, 2, generator=g),
            "displacement": torch.randn(n, 2, generator=g),
            "skill": skill,
        }

    root = state()
    root["action"] = torch.nn.functional.one_hot(action, 4) if one_hot else action
    after = state()
    after.update(
        reward=torch.randn(n, 1, generator=g), terminated=terminated, done=terminated.clone()
    )
    return TensorDict({**root, "next": TensorDict(after, batch_size=[n])}, batch_size=[n])


def to_double(td: TensorDict) -> TensorDict:
    return td.apply(lambda x: x.double() if x.is_floating_point() else x)


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
    out = SkillDiscriminatorLoss(net)(td)
    torch.testing.assert_close(out["loss_discriminator"], expected.mean())


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


def test_stacked_critics_agree_with_torchrls_vmap_and_loop() -> None:
    td = make_data()
    outs = []
    for vmap in (None, False, True):
        loss = make_loss(deactivate_vmap=vmap is False)
        if vmap is not None:
            DiscreteSACLoss._make_vmap(loss)
        outs.append(loss(td.clone()))
    for out in outs[1:]:
        torch.testing.assert_close(outs[0].to_dict(), out.to_dict())


def test_the_short_cuts_agree_with_torchrls_own_losses() -> None:
    loss, td = make_loss(), make_data()
    torch.testing.assert_close(
        loss._compute_target(td), DiscreteSACLoss._compute_target(loss, td.clone())
    )
    ours, theirs = loss.actor_loss(td), DiscreteSACLoss.actor_loss(loss, td.clone())
    torch.testing.assert_close(ours, theirs)
    # The parent's own forward calls the same methods, one after the other.
    parents = DiscreteSACLoss.forward(loss, td.clone())
    out = loss(td)
    for key in ("loss_actor", "loss_qvalue", "loss_alpha", "entropy"):
        torch.testing.assert_close(out[key], parents[key])


@pytest.mark.parametrize("one_hot", [False, True])
def test_an_actor_of_another_kind_is_asked_for_its_distribution(one_hot: bool) -> None:
    td = make_data(one_hot=one_hot)
    expected = make_loss(one_hot=one_hot)(td.clone())
    loss = make_loss(one_hot=one_hot)
    loss._only_logits = False
    torch.testing.assert_close(loss(td).to_dict(), expected.to_dict())


@pytest.mark.parametrize("skip_done_states", [False, True])
def test_a_truncated_state_has_a_value_and_a_terminal_one_none(skip_done_states: bool) -> None:
    td = make_data()
    td["next", "done"][:3] = True  # the first is terminated, the next two are truncated
    loss = make_loss(skip_done_states=skip_done_states)
    target = loss._compute_target(td)
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


def test_concatenated_skills_run_as_stacked_critics_too() -> None:
    torch.manual_seed(0)
    sizes = {"hidden": (8, 8), "network": ConcatSkillMLP}
    loss = DIAYNLoss(
        SkillActor(2, Categorical(4), 3, in_keys=["velocity"], **sizes),
        SkillCritic(4, 4, 3, in_keys=["velocity", "displacement"], **sizes),
        SkillDiscriminator(2, 3),
        action_space="categorical",
    )
    out = loss(make_data())
    DiscreteSACLoss._make_vmap(loss)
    torch.testing.assert_close(loss(make_data()).to_dict(), out.to_dict())


@pytest.mark.parametrize("name", GROUPS)
def test_the_gradient_of_each_loss_matches_finite_differences(name: str) -> None:
    loss, td = make_loss().double(), to_double(make_data())
    loss(td.clone())[name].backward()
    parameters = list(getattr(loss, GROUPS[name]).parameters())
    g = torch.Generator().manual_seed(0)
    direction = [torch.randn(p.shape, generator=g, dtype=p.dtype) for p in parameters]
    slope = sum((p.grad * d).sum() for p, d in zip(parameters, direction, strict=True))

    def moved(step: float) -> torch.Tensor:
        with torch.no_grad():
            for p, d in zip(parameters, direction, strict=True):
                p += step * d
            value = loss(td.clone())[name]
            for p, d in zip(parameters, direction, strict=True):
                p -= step * d
        return value

    difference = (moved(1e-5) - moved(-1e-5)) / 2e-5
    torch.testing.assert_close(slope, difference, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("name", GROUPS)
def test_each_loss_moves_only_its_own_parameters(name: str) -> None:
    loss = make_loss(fixed_alpha=False)
    loss(make_data())[name].backward()
    for group in GROUPS.values():
        grads = [p.grad for p in getattr(loss, group).parameters()]
        if group == GROUPS[name]:
            assert all(grad is not None and grad.abs().sum() > 0 for grad in grads)
        else:
            assert all(grad is None or not grad.any() for grad in grads)
    assert loss.log_alpha.grad is None


def test_a_tuned_alpha_falls_when_the_entropy_is_above_its_target() -> None:
    loss = make_loss(fixed_alpha=False, target_entropy=0.1)
    loss(make_data())["loss_alpha"].backward()
    assert loss.log_alpha.grad > 0  # descent lowers log alpha
    assert all(p.grad is None for p in loss.actor_network_params.parameters())


def test_one_hot_actions_give_the_same_losses() -> None:
    plain = make_loss()(make_data())
    hot = make_loss(one_hot=True)(make_data(one_hot=True))
    torch.testing.assert_close(plain["loss_qvalue"], hot["loss_qvalue"])
    torch.testing.assert_close(plain["loss_actor"], hot["loss_actor"])


def test_mean_and_sum_are_those_of_the_unreduced_losses() -> None:
    td = make_data()
    none, mean, total = (make_loss(reduction=r)(td.clone()) for r in ("none", "mean", "sum"))
    assert "alpha" not in none.keys()
    keys = ["loss_actor", "loss_qvalue", "loss_alpha", "loss_discriminator", "qvalue_loss_1"]
    for key in keys:
        assert none[key].shape == (6,)
        torch.testing.assert_close(none[key].mean(), mean[key])
        torch.testing.assert_close(none[key].sum(), total[key])


def test_output_keys_are_announced_and_diagnostics_are_detached() -> None:
    loss = make_loss()
    out = loss(make_data())
    assert set(out.keys()) == set(loss.out_keys)
    for key, value in out.items():
        assert value.requires_grad == (key.startswith("loss") and key != "loss_alpha")


def test_the_loss_takes_keyword_tensors_too() -> None:
    loss = make_loss()
    td = make_data()
    keywords = {"_".join(key) if isinstance(key, tuple) else key: td[key] for key in loss.in_keys}
    out = dict(zip(loss.out_keys, loss(**keywords), strict=True))
    torch.testing.assert_close(out["loss_discriminator"], loss(td)["loss_discriminator"])


def test_set_keys_moves_every_key_flat_or_nested() -> None:
    td = make_data()
    expected = make_loss()(td.clone())
    spec = Categorical(4)
    torch.manual_seed(0)
    sizes = {"hidden": (8, 8), "activation": torch.nn.Tanh, "skill_key": ("agent", "z")}
    actor = SkillActor(
        2, spec, 3, in_keys=[("agent", "v")], action_key=("agent", "action"), **sizes
    )
    keys = [("agent", "v"), ("agent", "d")]
    critic = SkillCritic(4, 4, 3, in_keys=keys, action_value_key=("agent", "q"), **sizes)
    discriminator = SkillDiscriminator(
        2, 3, in_keys=[("agent", "d")], skill_logits_key=("agent", "guess")
    )
    loss = DIAYNLoss(actor, critic, discriminator, action_space=spec)
    names = {"velocity": "v", "displacement": "d", "skill": "z", "action": "action"}
    loss.set_keys(
        action=("agent", "action"),
        action_value=("agent", "q"),
        skill=("agent", "z"),
        skill_logits=("agent", "guess"),
        reward="intrinsic",
    )
    after = td.pop("next")
    moved = TensorDict({"agent": {names[k]: v for k, v in td.items()}}, batch_size=[6])
    moved["next"] = TensorDict(
        {
            "agent": {names[k]: after[k] for k in ("velocity", "displacement", "skill")},
            "intrinsic": after["reward"],
            "done": after["done"],
            "terminated": after["terminated"],
        },
        batch_size=[6],
    )
    assert set(loss.in_keys) <= set(moved.keys(True, True))
    torch.testing.assert_close(loss(moved).to_dict(), expected.to_dict())
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(nonsense="x")


def test_the_state_dict_round_trips_and_does_not_grow_on_use() -> None:
    first, second = make_loss(seed=0), make_loss(seed=1)
    before = set(first.state_dict())
    first(make_data())
    assert set(first.state_dict()) == before
    second.load_state_dict(first.state_dict())
    torch.testing.assert_close(first(make_data()).to_dict(), second(make_data()).to_dict())


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


def test_bad_arguments_are_refused_with_their_value() -> None:
    with pytest.raises(ValueError, match=r"gamma.*1\.5"):
        make_loss(gamma=1.5)
    with pytest.raises(ValueError, match="alpha_init must be positive"):
        make_loss(alpha_init=0.0)
    with pytest.raises(ValueError, match="median"):
        make_loss(reduction="median")
