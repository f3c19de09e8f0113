"""Skill sampling, displacement and intrinsic reward."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import (
    Bounded,
    Categorical,
    Composite,
    Unbounded,
)
from torchrl.envs import Compose, EnvBase, GymEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.modules import GrowingSkillPrior, SkillDiscriminator, SkillDynamics
from torchrl_hmcts.objectives import SkillDiscriminatorLoss, SkillDynamicsLoss
from torchrl_hmcts.testing import ContractError, check_transform
from torchrl_hmcts.transforms import (
    DisplacementTransform,
    SkillReward,
    SkillTransform,
)


class Line(EnvBase):
    """Moves by +1 or -1 on a line; element i of a batch ends every ``ends[i]`` steps."""

    batch_locked = False
    _supports_set_state = True

    def __init__(self, batch_size: Sequence[int] = (), ends: int = 1000) -> None:
        super().__init__(batch_size=torch.Size(batch_size))
        shape = self.batch_size
        spec = {
            "position": Unbounded((*shape, 1)),
            "age": Bounded(0, 10_000, shape=(*shape, 1), dtype=torch.int64),
        }
        self.observation_spec = Composite(spec, shape=shape)
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Categorical(2, shape=shape)
        self.reward_spec = Unbounded((*shape, 1))
        self.ends = ends

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _reset(self, td: TensorDictBase | None, **kwargs: Any) -> TensorDict:
        shape = self.batch_size if td is None else td.batch_size
        if kwargs.get("set_state"):
            return td.select("position", "age")
        # Elements are of different ages, so that their episodes end at different steps.
        age = torch.arange(shape.numel()).view(*shape, 1)
        return TensorDict({"position": 10.0 * age.float(), "age": age}, batch_size=shape)

    def _step(self, td: TensorDictBase) -> TensorDict:
        age = td["age"] + 1
        done = age >= self.ends
        position = td["position"] + 2.0 * td["action"].unsqueeze(-1) - 1.0
        return TensorDict(
            {
                "position": position,
                "age": age,
                "reward": torch.ones_like(position),
                "done": done,
                "terminated": done.clone(),
            },
            batch_size=td.batch_size,
        )


def make_env(batch: Sequence[int] = (), ends: int = 1000, **kwargs: Any) -> TransformedEnv:
    kwargs = {"num_skills": 50, "max_skill_steps": 3, "seed": 0, **kwargs}
    return TransformedEnv(
        Line(batch, ends), Compose(SkillTransform(**kwargs), DisplacementTransform())
    )


def test_specs_are_exact_around_batched_envs() -> None:
    env = TransformedEnv(SerialEnv(2, Line), Compose(SkillTransform(4, 3), DisplacementTransform()))
    check_env_specs(env)
    data = env.rollout(4, break_when_any_done=False)
    assert data["skill_step"][0].flatten().tolist() == [0, 1, 2, 0]


def test_a_mini_episode_keeps_its_skill_and_the_next_root_has_a_new_one() -> None:
    data = make_env().rollout(9)
    skill = data["skill"].tolist()
    assert data["skill_step"].flatten().tolist() == [0, 1, 2] * 3
    assert [len(set(skill[i : i + 3])) for i in (0, 3, 6)] == [1, 1, 1]
    assert len(set(skill)) == 3  # of 50, by this seed
    assert data["next", "skill"].tolist() == skill  # also on the last step of a mini-episode
    assert data["next", "skill_step"].flatten().tolist() == [1, 2, 3] * 3
    assert not data["next", "done"].any()


def test_displacement_is_measured_from_where_the_skill_began() -> None:
    data = make_env((3,)).rollout(9)
    root, after = data["position"], data["next", "position"]
    origin = root[:, [0, 0, 0, 3, 3, 3, 6, 6, 6]]
    torch.testing.assert_close(data["displacement"], root - origin)
    torch.testing.assert_close(data["next", "displacement"], after - origin)
    assert not data["displacement"][:, [0, 3, 6]].any()


def test_partial_resets_touch_only_the_elements_that_end() -> None:
    data = make_env((4,), ends=5).rollout(4, break_when_any_done=False)
    # Element i is born with age i and lasts 5 - i steps; then it is born again with age i.
    steps = data["skill_step"].squeeze(-1).tolist()
    assert steps == [[0, 1, 2, 0], [0, 1, 2, 0], [0, 1, 2, 0], [0, 1, 0, 1]]
    assert data["next", "done"].squeeze(-1).tolist()[3] == [False, True, False, True]
    torch.testing.assert_close(data["next", "skill"], data["skill"])
    assert data["skill"][3, 0] == data["skill"][3, 1] != data["skill"][3, 2]
    assert not data["displacement"][3, 2].any()
    assert data["displacement"][3, 1].any()


def test_one_skill_lasts_the_episode_without_a_limit() -> None:
    data = make_env((2,), max_skill_steps=None).rollout(20)
    assert (data["skill"] == data["skill"][:, :1]).all()
    assert data["skill_step"][0].flatten().tolist() == list(range(20))


def test_a_given_skill_survives_reset_with_and_without_a_state() -> None:
    env = make_env((3,))
    chosen = torch.tensor([7, 8, 9])
    td = env.reset(TensorDict(skill=chosen, batch_size=[3]))
    assert torch.equal(td["skill"], chosen)
    assert not td["skill_step"].any()
    later = env.rollout(3, auto_reset=False, tensordict=td)[:, 1]
    state = later.exclude("next", "action")
    again = env.reset(state.clone(), set_state=True)
    for key in ("skill", "skill_step", "origin", "displacement", "position"):
        torch.testing.assert_close(again[key], later[key])


def test_samples_follow_the_prior_and_the_seed() -> None:
    transform = SkillTransform(3, prior=[2.0, 1.0, 1.0], seed=0)
    frequency = transform.sample([20_000]).bincount(minlength=3) / 20_000
    torch.testing.assert_close(frequency, torch.tensor([0.5, 0.25, 0.25]), atol=0.02, rtol=0)
    first, second = SkillTransform(9, seed=3), SkillTransform(9, seed=3)
    assert torch.equal(first.sample([30]), second.sample([30]))
    third = SkillTransform(9, seed=4)
    third.load_state_dict(first.state_dict())
    assert torch.equal(first.sample([30]), third.sample([30]))


def test_a_skill_prior_is_read_at_every_draw_and_stays_its_owners() -> None:
    prior = GrowingSkillPrior(50, num_active=1)
    env = make_env((8,), prior=prior)
    check_env_specs(env)
    assert not env.rollout(9)["skill"].any()
    prior.set_num_active(2)
    assert env.rollout(30)["skill"].unique().tolist() == [0, 1]
    transform = SkillTransform(50, prior=prior)
    assert list(transform.state_dict()) == ["_extra_state"]
    assert list(transform.buffers()) == []


def test_a_skill_that_is_switched_off_ends_its_mini_episode_at_the_next_step() -> None:
    prior = GrowingSkillPrior(50, num_active=50)
    for limit in (1000, None):
        prior.set_num_active(50)
        env = make_env((16,), max_skill_steps=limit, prior=prior)
        td = env.reset(TensorDict(skill=torch.arange(16), batch_size=[16]))
        after, root = env.step_and_maybe_reset(td.set("action", torch.ones(16, dtype=torch.int64)))
        assert torch.equal(root["skill"], torch.arange(16))
        prior.set_num_active(4)
        root.set("action", torch.ones(16, dtype=torch.int64))
        after, root = env.step_and_maybe_reset(root)
        assert torch.equal(after["next", "skill"], torch.arange(16))
        assert root["skill"][:4].tolist() == [0, 1, 2, 3]
        assert int(root["skill"].max()) < 4
        assert root["skill_step"].flatten().tolist() == [2] * 4 + [0] * 12


def a_discriminator() -> SkillDiscriminator:
    net = SkillDiscriminator(1, 2)
    with torch.no_grad():
        net.network[0].weight.copy_(torch.tensor([[1.0], [0.0]]))
        net.network[0].bias.zero_()
    return net


def discriminator_reward(
    network: SkillDiscriminator, prior: Sequence[float] | None = None, **kwargs: Any
) -> SkillReward:
    return SkillReward(SkillDiscriminatorLoss(network, prior=prior), **kwargs)


def transitions() -> TensorDict:
    after = TensorDict(
        displacement=torch.tensor([[math.log(3.0)], [0.0]]),
        reward=torch.ones(2, 1),
        batch_size=[2],
    )
    return TensorDict(skill=torch.tensor([0, 1]), next=after, batch_size=[2])


@pytest.mark.parametrize(
    ("kwargs", "expected"),
    [
        ({}, [math.log(0.75 / 0.5), 0.0]),  # q(0 | log 3) = 3 / 4 and q(1 | 0) = 1 / 2
        ({"prior": [3.0, 1.0]}, [0.0, math.log(0.5 / 0.25)]),
        ({"extrinsic_coeff": 2.0}, [math.log(1.5) + 2.0, 2.0]),
        ({"intrinsic_coeff": 3.0}, [3 * math.log(1.5), 0.0]),
    ],
)
def test_the_reward_has_its_closed_form(kwargs: dict[str, Any], expected: list[float]) -> None:
    out = discriminator_reward(a_discriminator(), **kwargs)(transitions())
    torch.testing.assert_close(out["next", "reward"], torch.tensor(expected)[:, None])
    assert not out["next", "reward"].requires_grad


def test_a_reward_of_another_name_stands_beside_the_envs_own() -> None:
    objective = SkillDiscriminatorLoss(SkillDiscriminator(3, 4, in_keys=["observation"]))

    def rewarded(reward: SkillReward) -> EnvBase:
        return TransformedEnv(GymEnv("Pendulum-v1"), Compose(SkillTransform(4, 3), reward))

    env = rewarded(SkillReward(objective, reward_key=("own", "intrinsic")))
    check_env_specs(env)
    after = env.rollout(5)["next"]
    assert after["own", "intrinsic"].shape == after["reward"].shape == (5, 1)
    assert (after["reward"] < 0).all()  # Pendulum's cost
    mixed = SkillReward(objective, reward_key="intrinsic", extrinsic_coeff=1.0)
    with pytest.raises(ValueError, match=r"mixes in.*'intrinsic'.*has \['reward'\].*reward_key"):
        rewarded(mixed).rollout(1)


def test_dynamics_of_another_size_than_what_they_predict_are_refused() -> None:
    keys = {"in_keys": ["observation"], "target_key": "observation"}
    objective = SkillDynamicsLoss(SkillDynamics(3, 5, 4, **keys))
    env = GymEnv("Pendulum-v1").append_transform(SkillTransform(4))
    with pytest.raises(ValueError, match="dynamics of 5 numbers, but 'observation' has 3"):
        env.append_transform(SkillReward(objective)).rollout(1)


def test_entries_that_are_missing_are_named() -> None:
    with pytest.raises(KeyError, match="after the SkillTransform"):
        _ = TransformedEnv(Line(), DisplacementTransform()).observation_spec
    env = make_env()
    with pytest.raises(KeyError, match="skill"):
        env.step(env.reset().exclude("skill").set("action", torch.tensor(0)))


def a_reward(**kwargs: Any) -> SkillReward:
    torch.manual_seed(0)
    return discriminator_reward(SkillDiscriminator(2, num_skills=4), **kwargs)


def test_a_transform_that_writes_into_what_is_stored_fails_the_check() -> None:
    class InPlace(SkillReward):
        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            self._score(tensordict, tensordict.get("next"))
            return tensordict

    objective = SkillDiscriminatorLoss(SkillDiscriminator(1, num_skills=2, in_keys=["position"]))
    data = TransformedEnv(Line(), SkillTransform(2)).rollout(3)
    with pytest.raises(
        ContractError, match="InPlace changed what is stored in a LazyTensorStorage"
    ):
        check_transform(
            lambda: InPlace(objective, extrinsic_coeff=1.0),
            lambda: TransformedEnv(Line(), SkillTransform(2)),
            data=data,
            data_writes=[("next", "reward")],
            checks=["replay_buffer"],
        )
