"""Skills that are vectors: drawn, learned by METRA, LSD and DADS, and planned with by a table."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Categorical, MultiCategorical, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, GymEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.envs import OptionPool, SkillWorker
from torchrl_hmcts.modules import (
    SkillActor,
    SkillDiscriminator,
    SkillDynamics,
    SkillEncoder,
    SkillMLP,
    SkillPolicy,
    SpectralLinear,
    UnitSphere,
    spread_skills,
)
from torchrl_hmcts.modules.skill_mlp import SkillNetwork
from torchrl_hmcts.modules.skill_spec import draw_vectors
from torchrl_hmcts.objectives import (
    LSDEncoderLoss,
    METRAEncoderLoss,
    SkillDiscriminatorLoss,
    SkillDynamicsLoss,
    SkillObjective,
)
from torchrl_hmcts.planners import MCTSPlanner, SearchBudget
from torchrl_hmcts.testing import PointMassEnv, check_skill_objective
from torchrl_hmcts.trainers import DIAYNTrainer
from torchrl_hmcts.transforms import (
    DisplacementTransform,
    OptionTransform,
    SkillReward,
    SkillTransform,
)

SPECS = {
    "sphere": UnitSphere(2),
    "box": Bounded(-1.0, 3.0, shape=(2,)),
    "normal": Unbounded(shape=(2,)),
}
KINDS = ("metra", "lsd", "dads")


def make_objective(
    kind: str, spec: TensorSpec, name: Callable[[Any], Any] = lambda key: key, **kwargs: Any
) -> SkillObjective:
    torch.manual_seed(0)
    keys: dict[str, Any] = {"in_keys": [name("position")], "activation": torch.nn.Tanh}
    if kind == "dads":
        keys |= {"target_key": name("position"), "skill_key": name("skill")}
        keys |= {"loc_key": name("skill_loc"), "scale_key": name("skill_scale")}
        return SkillDynamicsLoss(SkillDynamics(2, 2, spec, std=2.0, hidden=(8,), **keys), **kwargs)
    keys["representation_key"] = name("representation")
    if kind == "lsd":
        encoder = SkillEncoder(2, spec, hidden=(8,), linear=SpectralLinear, **keys)
        return LSDEncoderLoss(encoder, **kwargs)
    return METRAEncoderLoss(SkillEncoder(2, spec, hidden=(8,), **keys), **kwargs)


def transitions(*batch: int) -> TensorDict:
    g = torch.Generator().manual_seed(0)
    position, after, skill = torch.randn(3, *batch, 2, generator=g)
    data = TensorDict(position=position, skill=skill, batch_size=batch)
    return data.set("next", TensorDict(position=after, batch_size=batch))


# ---------------------------------------------------------------------- what is drawn


def test_a_unit_sphere_stays_one_through_all_that_envs_do_with_specs() -> None:
    sphere = UnitSphere(3)
    others = [sphere.clone(), sphere.expand(4, 3), sphere.to("cpu"), sphere.to(torch.float64)]
    others += [copy.deepcopy(sphere), torch.stack([sphere, sphere]), sphere.expand(4, 3)[0]]
    for spec in others:
        assert isinstance(spec, UnitSphere)
        drawn = spec.rand((50,))
        assert drawn.shape == (50, *spec.shape)
        assert drawn.dtype == spec.dtype
        torch.testing.assert_close(drawn.norm(dim=-1), torch.ones(drawn.shape[:-1]).to(drawn))
        assert spec.is_in(spec.rand())
    assert not sphere.is_in(torch.ones(3))
    assert sphere.is_in(sphere.project(torch.ones(3)))
    assert sphere.rand((20_000,)).mean(0).abs().max() < 0.03  # no direction is preferred


@pytest.mark.parametrize("name", SPECS)
def test_mini_episodes_draw_vectors_as_their_spec_says(name: str) -> None:
    env = TransformedEnv(
        PointMassEnv(batch_size=[500]),
        Compose(SkillTransform(SPECS[name], 2, seed=0), DisplacementTransform()),
    )
    check_env_specs(env)
    env.transform[0].set_seed(1)
    data = env.rollout(4)
    skill = data["skill"]
    assert skill.shape == (500, 4, 2)
    assert skill[:, 0].equal(skill[:, 1])
    assert data["next", "skill"][:, 1].equal(skill[:, 1])  # bootstrapped with the one that acted
    assert (skill[:, 2] != skill[:, 1]).all()
    drawn = skill[:, ::2].flatten(0, 1)
    if name == "sphere":
        torch.testing.assert_close(drawn.norm(dim=-1), torch.ones(1000))
    mean, std = {"sphere": (0.0, 0.5**0.5), "box": (1.0, 4 / 12**0.5), "normal": (0.0, 1.0)}[name]
    assert (drawn.mean(0) - mean).abs().max() < 0.12
    assert (drawn.std(0) - std).abs().max() < 0.06
    if name == "box":
        assert drawn.min() >= -1.0
        assert drawn.max() <= 3.0
    env.transform[0].set_seed(1)
    assert env.rollout(4)["skill"].equal(skill)
    given = env.reset(TensorDict(skill=skill[:, 0], batch_size=[500]))
    assert given["skill"].equal(skill[:, 0])


# ---------------------------------------------------------------------- objectives


def test_metra_and_lsd_reward_travel_along_the_vector_itself() -> None:
    encoder = SkillNetwork(torch.nn.Identity(), ["position"], "representation")  # phi(x) = x
    data = TensorDict(
        position=torch.tensor([[1.0, 1.0], [0.0, 0.0]]),
        skill=torch.tensor([[0.6, 0.8], [0.0, -2.0]]),
        next=TensorDict(position=torch.tensor([[1.5, 1.0], [3.0, 0.25]]), batch_size=[2]),
        batch_size=[2],
    )
    metra = METRAEncoderLoss(encoder, num_skills=UnitSphere(2), reduction="none", dual_init=2.0)
    lsd = LSDEncoderLoss(encoder, num_skills=UnitSphere(2), reduction="none")
    right = torch.tensor([0.3, -0.5])
    for objective in (metra, lsd):
        torch.testing.assert_close(objective.reward(data), right.unsqueeze(-1))
    torch.testing.assert_close(lsd(data)["loss_encoder"], -right)
    # One step is 0.5 long, with the constraint fulfilled, the other 9.0625 squared.
    room = torch.tensor([1e-3, 1.0 - 9.0625])
    torch.testing.assert_close(metra(data)["loss_encoder"], -right - 2.0 * room)


def test_dads_compares_with_vectors_drawn_from_the_prior_and_the_skill_itself() -> None:
    objective: Any = make_objective("dads", SPECS["box"], prior_samples=20, reduction="none")
    data = transitions(5)
    change = data["next", "position"] - data["position"]

    def log_density(skill: Tensor) -> Tensor:
        out = objective.dynamics(data.clone().set("skill", skill))
        q = torch.distributions.Normal(out["skill_loc"], out["skill_scale"])
        return q.log_prob(change).sum(-1)

    torch.manual_seed(3)
    drawn = draw_vectors(SPECS["box"], (20,))
    own = log_density(data["skill"])
    others = torch.stack([log_density(z.expand(5, 2)) for z in drawn], -1)
    together = torch.cat((own.unsqueeze(-1), others), -1)
    right = own - together.exp().mean(-1).log()
    torch.manual_seed(3)
    torch.testing.assert_close(objective.reward(data).squeeze(-1), right)
    torch.manual_seed(3)
    out = objective(data)
    torch.testing.assert_close(out["loss_dynamics"], -own)
    assert out["dynamics_accuracy"].equal((own >= others.amax(-1)).float())
    assert objective.reward(data).max() <= math.log(21)


@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt:FutureWarning")
@pytest.mark.parametrize("kind", KINDS)
def test_objectives_of_vectors_keep_the_contract(kind: str) -> None:
    make = partial(make_objective, kind, SPECS["normal"])
    trained = {
        "metra": {"loss_encoder": ["encoder_params"], "loss_dual": ["log_dual"]},
        "lsd": {"loss_encoder": ["encoder_params"]},
        "dads": {"loss_dynamics": ["dynamics_params"]},
    }[kind]
    check_skill_objective(
        lambda name, **kw: make(name=name, **kw), transitions(4), gradients=trained
    )
    whole = make(reduction="none")
    torch.manual_seed(0)
    rewards = whole.reward(transitions(2, 3)).shape
    assert rewards == (2, 3, 1)


@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize("kind", KINDS)
def test_all_parts_of_a_training_read_the_same_spec(kind: str, continuous: bool) -> None:
    base: EnvBase = GymEnv("Pendulum-v1") if continuous else PointMassEnv(batch_size=[16])
    key = "observation" if continuous else "position"
    size = base.full_observation_spec_unbatched[key].shape[-1]
    sphere = UnitSphere(3)
    env = TransformedEnv(base, Compose(SkillTransform(sphere, 10), DisplacementTransform(key)))
    objective: Any = {
        "metra": lambda: METRAEncoderLoss(SkillEncoder(size, sphere, in_keys=[key])),
        "lsd": lambda: LSDEncoderLoss(
            SkillEncoder(size, sphere, in_keys=[key], linear=SpectralLinear)
        ),
        "dads": lambda: SkillDynamicsLoss(
            SkillDynamics(size, size, sphere, in_keys=[key], target_key=key), prior_samples=8
        ),
    }[kind]()
    loss = DIAYNTrainer.make_loss(env, objective=objective, seed=0)
    trainer = DIAYNTrainer(env, loss, total_frames=128, batch_size=32, seed=0)
    before = [p.detach().clone() for p in loss.parameters()]
    trainer.train()
    moved = [not torch.equal(p, old) for p, old in zip(loss.parameters(), before, strict=True)]
    assert sum(moved) >= len(moved) - 2  # phi(s') - phi(s) has no bias; alpha is fixed
    assert all(math.isfinite(x) for values in trainer.history.values() for x in values)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_opposite_vectors_lead_to_opposite_places_after_a_short_training(seed: int) -> None:
    sphere = UnitSphere(2)
    env = TransformedEnv(
        PointMassEnv(batch_size=[32]), Compose(SkillTransform(sphere, 20), DisplacementTransform())
    )
    torch.manual_seed(seed)
    objective = METRAEncoderLoss(SkillEncoder(2, sphere))
    loss = DIAYNTrainer.make_loss(env, objective=objective, seed=seed)
    reward = SkillReward(objective, intrinsic_coeff=3.0)
    DIAYNTrainer(env, loss, total_frames=12_800, reward=reward, seed=seed).train()
    angle = torch.arange(16) * math.tau / 16
    table = torch.stack((angle.cos(), angle.sin()), -1)
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    macro = TransformedEnv(
        PointMassEnv(batch_size=[16]), OptionTransform(worker, 16, 20, skills=table)
    )
    td = macro.reset()
    start = td["position"].clone()
    moved = macro.step(td.set("option", torch.arange(16)))["next", "position"] - start
    opposite = torch.nn.functional.cosine_similarity(moved[:8], moved[8:], dim=-1)
    assert opposite.mean() < -0.5


# ---------------------------------------------------------------------- options


def follows(spec: TensorSpec, size: int = 2) -> SkillActor:
    torch.manual_seed(0)
    actions = Bounded(-2.0, 2.0, shape=(1,))
    return SkillActor(size, actions, spec, in_keys=["observation"])


def test_vectors_chosen_for_planning_are_spread_evenly() -> None:
    for number in (2, 3, 8):
        vectors = spread_skills(UnitSphere(2), number, seed=1)
        torch.testing.assert_close(vectors.norm(dim=-1), torch.ones(number))
        angles = torch.atan2(vectors[:, 1], vectors[:, 0]).sort().values
        gaps = torch.diff(angles, append=angles[:1] + math.tau)
        assert (gaps - math.tau / number).abs().max() < 0.15
    line = spread_skills(Bounded(0.0, 1.0, shape=(1,)), 4).flatten().sort().values
    torch.testing.assert_close(line, torch.tensor([1.0, 3, 5, 7]) / 8, atol=0.03, rtol=0)
    assert spread_skills(UnitSphere(2), 3).equal(spread_skills(UnitSphere(2), 3))
    assert spread_skills(UnitSphere(2), 1).shape == (1, 2)


def test_a_worker_is_told_the_vector_of_its_option_and_is_planned_with() -> None:
    actor = follows(UnitSphere(4), 3)
    table = spread_skills(UnitSphere(4), 5)
    options = OptionTransform(
        SkillPolicy(actor, deterministic=True), 5, 3, skills=table, trajectory_keys=["skill"]
    )
    env = TransformedEnv(GymEnv("Pendulum-v1"), options)
    check_env_specs(env)
    for option in (0, 4):
        after = env.step(env.reset().set("option", torch.tensor(option)))["next"]
        assert after["trajectory", "skill"].equal(table[option].expand(3, 4))
    fresh = OptionTransform(options.worker, 5, 3, skills=torch.zeros_like(table))
    TransformedEnv(GymEnv("Pendulum-v1"), fresh).load_state_dict(env.state_dict())
    assert fresh.skills.equal(table)
    told = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])

    def push(td: TensorDict) -> TensorDict:  # discrete actions: right, up, left, down
        return td.set("action", (td["skill"] @ told.T).argmax(-1))

    push.in_keys = ["skill"]  # type: ignore[attr-defined]
    for batch in ([], [3]):
        plain = PointMassEnv(batch_size=batch)
        table = told[torch.tensor([2, 0])]
        macro = TransformedEnv(plain, OptionTransform(push, 2, 4, skills=table))
        search = MCTSPlanner(macro, budget=SearchBudget(expansions=2, until_plan=False))
        assert search(macro.reset())["option"].shape == torch.Size(batch)


@pytest.mark.parametrize("activation", [torch.nn.ReLU, torch.nn.Tanh])  # compiled, in torch
def test_a_pools_worker_acts_as_the_policy_does(activation: Any) -> None:
    torch.manual_seed(0)
    actions = Bounded(-2.0, 2.0, shape=(1,))
    keys = {"in_keys": ["observation"], "activation": activation}
    actor = SkillActor(3, actions, UnitSphere(4), **keys)
    table = spread_skills(UnitSphere(4), 5)
    worker = SkillWorker(actor, deterministic=True, skills=table)
    pool = OptionPool("Pendulum-v1", worker, max_steps=3, num_processes=0)
    assert pool.num_options == 5
    policy, seen = SkillPolicy(actor, deterministic=True), np.array([0.1, -0.4, 2.0])
    for option in range(5):
        td = TensorDict(observation=torch.from_numpy(seen), skill=table[option])
        right = policy(td)["action"].numpy()
        acted = worker.act(seen, option, np.random.default_rng(0))
        np.testing.assert_allclose(acted, right, rtol=1e-5)
    with pytest.raises(
        ValueError, match=r"vectors of 4 numbers needs skills= of \[Z, 4\]; got none"
    ):
        SkillWorker(actor)


# ---------------------------------------------------------------------- bad input


def on_pendulum(worker: Any, **kwargs: Any) -> EnvBase:
    return TransformedEnv(GymEnv("Pendulum-v1"), OptionTransform(worker, 4, 5, **kwargs))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SkillTransform(UnitSphere(2), prior=[1, 2]), "these are vectors of 2 numbers"),
        (
            lambda: METRAEncoderLoss(SkillEncoder(2, UnitSphere(2)), prior=[1, 2]),
            "METRAEncoderLoss takes a prior over a number of skills",
        ),
        (lambda: SkillMLP(2, 2, UnitSphere(2)), "Use ConcatSkillMLP"),
        (lambda: SkillDiscriminator(2, UnitSphere(2)), "needs numbered skills.*METRA"),
        (
            lambda: SkillDiscriminatorLoss(SkillEncoder(2, UnitSphere(2))),
            "SkillDiscriminatorLoss needs numbered skills.*METRA",
        ),
        (
            lambda: METRAEncoderLoss(SkillEncoder(2, UnitSphere(2)), num_skills=3),
            "made for 3 skills, but its SkillEncoder distinguishes vectors of 2 numbers",
        ),
        (lambda: SkillTransform(Bounded(-1, 1, shape=(2, 2))), r"float32, shape \[2, 2\]"),
        (lambda: SkillTransform(MultiCategorical([2, 3])), "got MultiCategorical of torch.int64"),
        (
            lambda: SkillTransform(Bounded(-math.inf, 1.0, shape=(2,))),
            "bounds of their spec, which must be finite",
        ),
        (lambda: spread_skills(Categorical(3), 2), "a spec of 3 skills, which are options"),
        (
            lambda: follows(UnitSphere(2))(transitions(3).set("observation", torch.zeros(3, 3))),
            "for 4 features",
        ),
        (
            lambda: follows(UnitSphere(2))(
                transitions(3)
                .set("observation", torch.zeros(3, 2))
                .set("skill", torch.zeros(3, dtype=torch.int64))
            ),
            r"must be vectors, floats \[3, 2\].*got torch.int64 \[3\].*skills=",
        ),
        (
            lambda: on_pendulum(SkillPolicy(follows(UnitSphere(2), 3))),
            r"vectors of 2 numbers, but gets options as their numbers.*\[4, 2\].*spread_skills",
        ),
        (
            lambda: on_pendulum(SkillPolicy(follows(UnitSphere(2), 3)), skills=torch.zeros(4, 3)),
            "gets options as vectors of 3 numbers",
        ),
        (
            lambda: on_pendulum(SkillPolicy(follows(Categorical(4), 3)), skills=torch.zeros(4, 3)),
            "knows skills as numbers.*no skills=",
        ),
        (
            lambda: on_pendulum(SkillPolicy(follows(UnitSphere(2), 3)), skills=torch.zeros(3, 2)),
            r"\[4, D\]; got 'torch.float32 \[3, 2\]'",
        ),
        (
            lambda: DIAYNTrainer.make_loss(
                TransformedEnv(GymEnv("Pendulum-v1"), SkillTransform(UnitSphere(2)))
            ),
            "needs numbered skills.*METRAEncoderLoss",
        ),
    ],
)
def test_what_does_not_fit_says_so(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_a_trainer_compares_what_its_env_draws_with_what_its_networks_know() -> None:
    def env(*transforms: Any) -> EnvBase:
        return TransformedEnv(GymEnv("Pendulum-v1"), Compose(*transforms))

    vectors = env(SkillTransform(UnitSphere(3)))
    objective = METRAEncoderLoss(SkillEncoder(3, UnitSphere(3), in_keys=["observation"]))
    loss = DIAYNTrainer.make_loss(vectors, objective=objective)
    for drawn, found in ((UnitSphere(2), "vectors of 2 numbers"), (4, "4 skills")):
        message = f"draws {found}.*knows vectors of 3 numbers.*both the same: one spec"
        with pytest.raises(ValueError, match=message):
            DIAYNTrainer(env(SkillTransform(drawn)), loss)
    with pytest.raises(KeyError, match="actor reads 'skill'.*Append a SkillTransform"):
        DIAYNTrainer(env(), loss)
    numbered = DIAYNTrainer.make_loss(env(SkillTransform(6)))  # as many as the env draws
    assert numbered.actor_network.num_skills == numbered.objective.num_skills == 6
    with pytest.raises(
        ValueError, match="draws 7 skills.*SkillPolicy knows 6 skills.*SkillTransform.6."
    ):
        DIAYNTrainer(env(SkillTransform(7)), numbered)
    with pytest.raises(ValueError, match="SkillReward: the env draws 7 skills"):
        env(SkillTransform(7), SkillReward(numbered.objective)).rollout(1)
