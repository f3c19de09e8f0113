"""Every transform keeps the contract of TorchRL's eleven transform tests, and of four more.

``check_transform`` holds what is common; what a transform must write, and the places where it must
refuse to be, are one row of a table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Categorical, Composite, OneHot, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
)

import torchrl_hmcts.transforms
from torchrl_hmcts.modules import (
    FixedSkillPrior,
    GrowingSkillPrior,
    SkillActor,
    SkillDiscriminator,
    SkillPolicy,
)
from torchrl_hmcts.objectives import SkillDiscriminatorLoss
from torchrl_hmcts.testing import (
    TRANSFORM_CHECKS,
    ChainEnv,
    PointMassEnv,
    check_macro_env,
    check_transform,
)
from torchrl_hmcts.transforms import (
    DisplacementTransform,
    OptionRecorder,
    OptionTransform,
    SkillMaskTransform,
    SkillReward,
    SkillTransform,
    StallTransform,
    SubgoalTransform,
)

PARALLEL = ("parallel", "trans_parallel")
# Processes take seconds to start; the others with the marker `slow`.
STARTED = {("option", "parallel"), ("stall", "trans_parallel")}
N = 5


# ------------------------------------------------------------------------------------ envs


class OneHotChain(ChainEnv):
    """A chain whose action is one-hot."""

    def __init__(self, length: int = 5) -> None:
        super().__init__(length=length)
        self.action_spec = OneHot(2)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        index = tensordict.get("action").long().argmax(-1)
        return super()._step(tensordict.copy().set("action", index))


class NestedPoint(EnvBase):
    """A point mass whose entries, action and reward are nested."""

    batch_locked = False

    def __init__(self) -> None:
        super().__init__()
        self.inner = PointMassEnv()
        spec = self.inner.observation_spec
        agent = Composite(x=spec["position"].clone(), v=spec["velocity"].clone())
        self.observation_spec = Composite(agent=agent)
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Composite(agent=Composite(push=Categorical(4)))
        self.reward_spec = Composite(agent=Composite(r=Unbounded((1,))))

    def _nest(self, flat: TensorDictBase) -> TensorDictBase:
        agent = {"x": flat.pop("position"), "v": flat.pop("velocity")}
        if "reward" in flat.keys():
            agent["r"] = flat.pop("reward")
        return flat.set("agent", TensorDict(agent, batch_size=flat.batch_size))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return self._nest(self.inner._reset(tensordict))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        agent = tensordict.get("agent")
        flat = {"position": agent["x"], "velocity": agent["v"], "action": agent["push"]}
        return self._nest(self.inner._step(TensorDict(flat, batch_size=agent.batch_size)))

    def _set_seed(self, seed: int | None) -> None:
        self.inner._set_seed(seed)


def chain_with_options(*, trajectory_keys: Any = None) -> EnvBase:
    options = OptionTransform(one_of_two(), 2, 3, trajectory_keys=trajectory_keys)
    return TransformedEnv(ChainEnv(length=9), options)


def nested_option(**kwargs: Any) -> OptionTransform:
    return OptionTransform(
        TensorDictModule(same, [("agent", "z")], [("agent", "push")]),
        4,
        3,
        option_key=("agent", "option"),
        skill_key=("agent", "z"),
        duration_key=("agent", "k"),
        **kwargs,
    )


def nested_skills() -> EnvBase:
    skill = SkillTransform(3, skill_key=("agent", "z"), skill_step_key=("agent", "k"))
    return TransformedEnv(NestedPoint(), skill)


def skilled_points() -> EnvBase:
    return TransformedEnv(PointMassEnv(), SkillTransform(3, 4))


def skilled_for_good() -> EnvBase:
    return TransformedEnv(PointMassEnv(), SkillTransform(3))


def counted_points() -> EnvBase:
    return TransformedEnv(PointMassEnv(), StepCounter(step_count_key="skill_step"))


# ------------------------------------------------------------------------------ transforms


def same(skill: Tensor) -> Tensor:
    return skill


def as_one_hot(skill: Tensor) -> Tensor:
    return torch.nn.functional.one_hot(skill, 2).bool()


def one_of_two() -> TensorDictModule:
    """To the left or to the right, as the option says."""
    return TensorDictModule(same, ["skill"], ["action"])


def nested_objective() -> SkillDiscriminatorLoss:
    objective = discriminator_objective(("agent", "x"))
    objective.set_keys(skill=("agent", "z"))
    return objective


def nested_transitions() -> TensorDict:
    flat = transitions()
    agent = {"z": flat["skill"], "x": flat["position"]}
    after = {"x": flat["next", "position"], "r": flat["next", "reward"]}
    following = TensorDict(agent=TensorDict(after, batch_size=[N]), batch_size=[N])
    return TensorDict(agent=TensorDict(agent, batch_size=[N]), next=following, batch_size=[N])


def learned_worker(key: Any = "velocity") -> SkillPolicy:
    torch.manual_seed(0)
    return SkillPolicy(SkillActor(2, Categorical(4), 3, in_keys=[key]), deterministic=True)


def one_and_two_to_the_right(td: TensorDictBase, key: Any = "position") -> tuple[Tensor, Tensor]:
    position = td.get(key)
    away = torch.tensor([[1.0, 0.0], [2.0, 0.0]], device=position.device)
    return position.unsqueeze(1) + away, torch.full((len(td),), 2)


def subgoals() -> SubgoalTransform:
    return SubgoalTransform(one_and_two_to_the_right, max_goals=4)


def discriminator_objective(key: Any = "position") -> SkillDiscriminatorLoss:
    torch.manual_seed(0)
    return SkillDiscriminatorLoss(SkillDiscriminator(2, 3, in_keys=[key]))


def transitions() -> TensorDict:
    g = torch.Generator().manual_seed(0)
    after = TensorDict(
        position=torch.randn(N, 2, generator=g), reward=torch.zeros(N, 1), batch_size=[N]
    )
    return TensorDict(
        position=torch.randn(N, 2, generator=g),
        skill=torch.arange(N) % 3,
        next=after,
        batch_size=[N],
    )


def recorder() -> OptionRecorder:
    return OptionRecorder(["state", "skill", ("next", "state")])


def nested_recorder() -> OptionRecorder:
    keys = [("agent", "x"), ("agent", "z"), ("next", "agent", "x")]
    return OptionRecorder(keys, skill_key=("agent", "z"))


def options_and_recorder() -> Transform:
    listener = recorder()
    options = OptionTransform(one_of_two(), 2, 3, trajectory_keys=listener.trajectory_keys)
    return Compose(options, listener)


Make = Callable[[], Transform]
MakeEnv = Callable[[], EnvBase]
CASES: dict[str, Case] = {}


@dataclass
class Case:
    """How to make a transform, on which env, and what is expected of it (see check_transform)."""

    make: Make
    env: MakeEnv
    expected: dict[str, Any]
    skip: Sequence[str]
    parallel: bool
    """Whether processes are started for it: one of each transform is enough."""


def case(
    name: str,
    make: Make,
    env: MakeEnv = PointMassEnv,
    *,
    skip: Sequence[str] = (),
    only: Sequence[str] = TRANSFORM_CHECKS,
    parallel: bool = False,
    **expected: Any,
) -> None:
    skip = [*skip, *(check for check in TRANSFORM_CHECKS if check not in only)]
    CASES[name] = Case(make, env, expected, skip, parallel)


SKILL: dict[str, Any] = {"writes": ["skill", "skill_step"]}
REDRAWN: dict[str, Any] = {"redrawn_keys": ["skill", "skill_step"], "inside_workers": False}
MOVED: dict[str, Any] = {"writes": ["displacement", "origin"]}
OPTION: dict[str, Any] = {
    "writes": ["duration"],
    "changes": ["reward"],
    "inverse_writes": ["action", "skill"],
}
REWARD: dict[str, Any] = {
    "data": transitions(),
    "data_writes": [("next", "reward")],
    "changes": ["reward"],
}
COUNTS = ["plan_length", "goal_index", "num_plans", "num_goals_met", "num_divergences"]
SUBGOAL: dict[str, Any] = {
    "writes": ["goals", "plan", *COUNTS],
    "writes_next": ["task_reward"],
    "changes": ["reward"],
}
TAKES: dict[str, Any] = {
    "changes": [("trajectory", "state"), ("trajectory", "next", "state"), ("trajectory", "mask")],
    "inside_workers": False,
    # It takes entries away: see the tests below. Around workers it needs the options there.
    "skip": ["env", "trans_serial"],
}
skills, moves, stall = (partial(SkillTransform, 3), DisplacementTransform, StallTransform)
chain = partial(ChainEnv, 9)

case("skill", skills, parallel=True, **SKILL)
case("skill_every_2_steps", partial(skills, 2, prior=[0.5, 0.3, 0.2]), **SKILL, **REDRAWN)
# A reset of the env's seed does not reach its generator.
case("skill_with_a_generator", partial(skills, 2, seed=0), only=["state_dict", "copy"])
case(
    "skill_nested",
    partial(skills, 2, skill_key=("agent", "z"), skill_step_key=("agent", "k")),
    NestedPoint,
    writes=[("agent", "z"), ("agent", "k")],
    redrawn_keys=[("agent", "z"), ("agent", "k")],
    inside_workers=False,
)
case("displacement", partial(moves, skill_step_key=None), parallel=True, **MOVED)
case(
    "displacement_since_the_skill_began",
    moves,
    skilled_points,
    redrawn_keys=["skill", "skill_step", "displacement", "origin"],
    inside_workers=False,
    # The env has a SkillTransform of its own, which may not be inside workers either.
    skip=["serial", "trans_serial"],
    **MOVED,
)
case("displacement_inside_workers", moves, counted_points, only=["serial"], inside_workers=False)
case(
    "displacement_nested",
    partial(moves, ("agent", "x"), ("agent", "d"), origin_key=("agent", "o"), skill_step_key=None),
    NestedPoint,
    writes=[("agent", "d"), ("agent", "o")],
)
case("skill_reward", lambda: SkillReward(discriminator_objective()), skilled_for_good, **REWARD)
case(
    "skill_reward_nested",
    lambda: SkillReward(nested_objective(), reward_key=("agent", "r")),
    nested_skills,
    data=nested_transitions(),
    data_writes=[("next", "agent", "r")],
    changes=[("agent", "r")],
)

case("option", lambda: OptionTransform(one_of_two(), 2, 3), chain, parallel=True, **OPTION)
case(
    "option_on_one_hot_actions",
    lambda: OptionTransform(TensorDictModule(as_one_hot, ["skill"], ["action"]), 2, 3),
    OneHotChain,
    **OPTION,
)
case(
    "option_nested",
    nested_option,
    NestedPoint,
    writes=[("agent", "k")],
    changes=[("agent", "r")],
    inverse_writes=[("agent", "push"), ("agent", "z")],
)
case(
    "option_with_a_network_and_trajectories",
    lambda: OptionTransform(
        learned_worker(), 3, 4, trajectory_keys=["position", ("next", "reward")]
    ),
    **{**OPTION, "writes": ["duration", ("trajectory", "position"), ("trajectory", "mask")]},
)
case(
    "recorder",
    recorder,
    partial(chain_with_options, trajectory_keys=recorder().trajectory_keys),
    **TAKES,
)
case(
    "recorder_nested",
    nested_recorder,
    lambda: TransformedEnv(
        NestedPoint(), nested_option(trajectory_keys=nested_recorder().trajectory_keys)
    ),
    **{
        **TAKES,
        "changes": [
            ("trajectory", "agent", "x"),
            ("trajectory", "next", "agent", "x"),
            ("trajectory", "mask"),
        ],
    },
)
case(
    "options_and_recorder",
    options_and_recorder,
    chain,
    only=["single", "parallel", "trans_serial", "trans_parallel", "state_dict", "copy", "device"],
    inside_workers=False,
)
case(
    "skill_mask",
    lambda: SkillMaskTransform(FixedSkillPrior(2, [1.0, 0.0])),
    chain_with_options,
    writes=["action_mask"],
    inside_workers=False,
)
case(
    "skill_mask_nested",
    lambda: SkillMaskTransform(GrowingSkillPrior(2), mask_key=("agent", "mask")),
    chain_with_options,
    writes=[("agent", "mask")],
    inside_workers=False,
)
case("stall", partial(stall, "state", 0.5), ChainEnv, parallel=True, writes=["stalled_steps"])
case(
    "stall_nested",
    partial(stall, ("agent", "x"), 0.1, ("agent", "stalled")),
    NestedPoint,
    writes=[("agent", "stalled")],
)
case("subgoal", subgoals, parallel=True, **SUBGOAL)
case(
    "subgoal_nested",
    lambda: SubgoalTransform(
        partial(one_and_two_to_the_right, key=("agent", "x")),
        max_goals=4,
        position_key=("agent", "x"),
        reward_key=("agent", "r"),
        goals_key=("agent", "goals"),
        plan_key=("agent", "plan"),
        task_reward_key=("agent", "task_reward"),
        relative=False,
    ),
    NestedPoint,
    writes=[("agent", "goals"), ("agent", "plan"), *COUNTS],
    writes_next=[("agent", "task_reward")],
    changes=[("agent", "r")],
)


def on_env(case: Case) -> TransformedEnv:
    return TransformedEnv(case.env(), case.make(), auto_unwrap=True)


def rows() -> list[Any]:
    found = []
    for name, case in CASES.items():
        for check in TRANSFORM_CHECKS:
            if check in case.skip or (check in PARALLEL and not case.parallel):
                continue
            slow = check in PARALLEL and (name, check) not in STARTED
            marks = [pytest.mark.slow] if slow else []
            found.append(pytest.param(name, check, id=f"{name}-{check}", marks=marks))
    return found


@pytest.mark.parametrize(("name", "check"), rows())
def test_a_transform_keeps_the_contract(name: str, check: str) -> None:
    case = CASES[name]
    check_transform(case.make, case.env, **case.expected, start_method="fork", checks=[check])


def test_no_transform_that_is_exported_is_left_out() -> None:
    exported = {getattr(torchrl_hmcts.transforms, n) for n in torchrl_hmcts.transforms.__all__}
    transforms = {c for c in exported if issubclass(c, Transform)}
    assert transforms == {type(case.make()) for case in CASES.values()} - {Compose}


def is_nested(case: Case) -> bool:
    env = on_env(case)
    keys = [key for spec in (env.observation_spec, env.full_reward_spec) for key in spec.keys(True)]
    return any(isinstance(key, tuple) for key in keys)


def test_every_transform_is_tried_with_nested_keys() -> None:
    nested = {type(case.make()) for case in CASES.values() if is_nested(case)}
    assert nested >= {type(case.make()) for case in CASES.values()} - {Compose}


@pytest.mark.parametrize("name", CASES)
def test_specs_are_on_the_device_of_the_env(name: str) -> None:
    """With an env on the meta device a tensor that was made elsewhere would be seen."""
    case = CASES[name]
    if "option" in name or name.startswith(("recorder", "skill_mask")):
        pytest.skip("an OptionTransform runs its worker on real data when it is attached")
    env = TransformedEnv(case.env().to("meta"), case.make(), auto_unwrap=True)
    for spec in (env.full_observation_spec, env.full_state_spec, env.full_reward_spec):
        assert all(leaf.device.type == "meta" for leaf in spec.values(True, True))


def test_a_recorder_around_options_inside_workers_says_what_is_wrong() -> None:
    case = CASES["recorder"]
    env = TransformedEnv(SerialEnv(2, case.env), case.make())
    with pytest.raises(KeyError, match="same side of a SerialEnv"):
        env.rollout(1)


def test_a_recorder_takes_the_trajectory_out_and_leaves_the_rest() -> None:
    case = CASES["recorder"]
    env, plain = on_env(case), case.env()
    torch.manual_seed(0)
    actual = env.rollout(4)
    torch.manual_seed(0)
    expected = plain.rollout(4).exclude("trajectory", ("next", "trajectory"))
    assert set(actual.keys(True, True)) == set(expected.keys(True, True))
    for key in expected.keys(True, True):
        assert torch.equal(actual[key], expected[key])


MACRO_ENVS = {name: CASES[name] for name in CASES if name.startswith(("option", "skill_mask"))}


@pytest.mark.parametrize("name", MACRO_ENVS)
def test_an_env_of_options_keeps_the_contract_of_a_macro_env(name: str) -> None:
    case = MACRO_ENVS[name]
    env = on_env(case)
    duration = ("agent", "k") if name == "option_nested" else "duration"
    mask = ("agent", "mask") if "nested" in name else "action_mask"
    check_macro_env(env, duration_key=duration, mask_key=mask, tolerance=1e-5)
