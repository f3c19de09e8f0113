"""Configs of the transforms, group ``transform``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from torchrl_hmcts.trainers.configs.base import TransformComponentConfig


@dataclass
class OptionTransformConfig(TransformComponentConfig):
    """Keys of :class:`~torchrl_hmcts.transforms.OptionTransform`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from tensordict.nn import TensorDictModule
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> instantiate(OptionTransformConfig(num_options=4, max_steps=20, _partial_=True))(
        ...     worker=worker).max_steps
        20
    """

    worker: Any = MISSING
    """Reads observation or state entries and skill_key, writes the env's action."""
    num_options: int = MISSING
    """Number of options."""
    max_steps: int = MISSING
    """Base steps after which an option ends at the latest."""
    gamma: float = 0.99
    """Discount per base step, in (0, 1]."""
    termination: Any = None
    """Termination(td) -> bool tensor [*B] or [*B, 1], True where the option ends. td holds the
    entries after a base step, skill_key and the base steps taken so far under duration_key."""
    option_key: Any = "option"
    """The macro action, int64 [*B] (one-hot bool [*B, num_options] with one_hot=True)."""
    skill_key: Any = "skill"
    """The entry by which the worker is told the option, int64 [*B]."""
    duration_key: Any = "duration"
    """Base steps taken, int64 [*B, 1]."""
    one_hot: bool = False
    """Options are one-hot instead of categorical."""
    trajectory_keys: Any = None
    """Base transitions to hand out, e.g. to train the worker: entries as "position", "action" or
    ("next", "reward"), as ("next", "trajectory", ...) of shape [*B, T], zero after the option's
    end, with ("next", "trajectory", "mask")."""
    base_duration_key: Any = None
    """The entry, int64 [*B, 1], in which the env below counts the base steps of its steps."""
    worker_memory: str = "reset"
    """"reset", so that a recurrent worker begins each option with zeros, or "keep"."""
    _component_: str = "torchrl_hmcts.transforms.OptionTransform"


@dataclass
class SkillTransformConfig(TransformComponentConfig):
    """Keys of :class:`~torchrl_hmcts.transforms.SkillTransform`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(SkillTransformConfig(num_skills=4)).num_skills
        4
    """

    num_skills: int = MISSING
    """Number of skills Z."""
    max_skill_steps: int | None = None
    """Base steps per mini-episode."""
    skill_key: Any = "skill"
    """Entry of the skill."""
    skill_step_key: Any = "skill_step"
    """Entry of the steps taken."""
    prior: Any = None
    """Probabilities [Z] of the skills, normalised."""
    seed: int | None = None
    """Seed of an own generator, whose state is saved in the state dict."""
    _component_: str = "torchrl_hmcts.transforms.SkillTransform"


@dataclass
class SubgoalTransformConfig(TransformComponentConfig):
    """Keys of :class:`~torchrl_hmcts.transforms.SubgoalTransform`.

    Example:
        >>> from hydra.utils import instantiate
        >>> import torch
        >>> instantiate(SubgoalTransformConfig(num_goals=2, _partial_=True))(
        ...     planner=lambda td: (td["position"].unsqueeze(1) + 1, torch.ones(len(td)))).num_goals
        2
    """

    planner: Any = MISSING
    """The manager. planner(td [m]) -> (goals [m, L, D], lengths [m]), or an object with a method
    plan_goals of that form, e.g."""
    position_key: Any = "position"
    """Entry [*B, D] that is compared with the goals."""
    goal_met_threshold: float = 0.5
    """D_met, in the units of the position."""
    goal_divergence_threshold: float = 2.0
    """D_div; must be larger than the distance of one goal to the next. math.inf never plans
    again."""
    r_tick: float = -0.025
    """Reward of every base step."""
    r_goal_met: float = 1.0
    """Reward of a goal that is met."""
    r_goal_divergence: float = -1.0
    """Reward of straying beyond the threshold."""
    num_goals: int = 3
    """Goals that the worker sees."""
    max_goals: int = 64
    """G; a longer plan is cut, and goes on from a new plan when its last goal is met."""
    relative: bool = True
    """Show goals relative to the position, so that what the worker learns in one place holds in
    all, or as they are."""
    goals_key: Any = "goals"
    """Entry of the next goals."""
    plan_key: Any = "plan"
    """Entry of the whole plan."""
    plan_length_key: Any = "plan_length"
    """Entry of the number of goals in the plan."""
    goal_index_key: Any = "goal_index"
    """Entry of the index of the current goal."""
    num_plans_key: Any = "num_plans"
    """Entry of the number of plans made in the episode."""
    num_goals_met_key: Any = "num_goals_met"
    """Entry of the number of goals met in the episode."""
    num_divergences_key: Any = "num_divergences"
    """Entry of the number of times the worker strayed."""
    reward_key: Any = "reward"
    """The env's reward, which becomes the worker's."""
    task_reward_key: Any = "task_reward"
    """Where the env's reward goes."""
    _component_: str = "torchrl_hmcts.transforms.SubgoalTransform"


@dataclass
class DisplacementTransformConfig(TransformComponentConfig):
    """Keys of :class:`~torchrl_hmcts.transforms.DisplacementTransform`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(DisplacementTransformConfig()).out_keys
        ['displacement', 'origin']
    """

    in_key: Any = "position"
    """Entry [*B, D] to measure."""
    out_key: Any = "displacement"
    """Entry [*B, D] to write, in the units of in_key."""
    origin_key: Any = "origin"
    """Entry [*B, D] of the origin."""
    skill_step_key: Any = "skill_step"
    """The entry SkillTransform counts in; an origin moves where it is zero."""
    _component_: str = "torchrl_hmcts.transforms.DisplacementTransform"


@dataclass
class SkillRewardConfig(TransformComponentConfig):
    """Keys of :class:`~torchrl_hmcts.transforms.SkillReward`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss
        >>> objective = SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills=3))
        >>> instantiate(SkillRewardConfig(_partial_=True))(objective=objective).intrinsic_coeff
        1.0
    """

    objective: Any = MISSING
    """Gives the reward, e.g. loss.objective of a DiscreteSkillSACLoss."""
    intrinsic_coeff: float = 1.0
    """Weight of the intrinsic reward."""
    extrinsic_coeff: float = 0.0
    """Weight of the env's own reward."""
    reward_key: Any = "reward"
    """Reward to write, [*B, 1], under "next"."""
    _component_: str = "torchrl_hmcts.transforms.SkillReward"


@dataclass
class DIAYNRewardConfig(TransformComponentConfig):
    """Keys of :class:`~torchrl_hmcts.transforms.DIAYNReward`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> instantiate(DIAYNRewardConfig(num_skills=3, _partial_=True))(
        ...     discriminator=SkillDiscriminator(2, num_skills=3)).reward_key
        'reward'
    """

    discriminator: Any = MISSING
    """Writes the logits [*B, Z] of q(z | s') from its in_keys, which are read from the "next" part
    of a transition."""
    num_skills: int = MISSING
    """Number of skills Z."""
    prior: Any = None
    """P(z), [Z], normalised; skills of probability 0 are not guessed."""
    intrinsic_coeff: float = 1.0
    """Weight of the intrinsic reward."""
    extrinsic_coeff: float = 0.0
    """Weight of the env's own reward."""
    skill_key: Any = "skill"
    """Entry of the skill, int64 [*B]."""
    skill_logits_key: Any = "skill_logits"
    """Entry the discriminator writes."""
    reward_key: Any = "reward"
    """Reward to write, [*B, 1], under "next"."""
    _component_: str = "torchrl_hmcts.transforms.DIAYNReward"


@dataclass
class SkillMaskTransformConfig(TransformComponentConfig):
    """Keys of :class:`~torchrl_hmcts.transforms.SkillMaskTransform`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import FixedSkillPrior
        >>> instantiate(SkillMaskTransformConfig(_partial_=True))(
        ...     prior=FixedSkillPrior(3)).out_keys
        ['action_mask']
    """

    prior: Any = MISSING
    """Over the skills, one per option, Z."""
    mask_key: Any = "action_mask"
    """Entry to write, bool [*B, Z]."""
    _component_: str = "torchrl_hmcts.transforms.SkillMaskTransform"


@dataclass
class StallTransformConfig(TransformComponentConfig):
    """Keys of :class:`~torchrl_hmcts.transforms.StallTransform`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(StallTransformConfig()).out_keys
        ['stalled_steps']
    """

    in_key: Any = "position"
    """Entry [*B, ...] that should move."""
    tolerance: float = 0.001
    """Distance (Euclidean, over all but the batch dimensions), in the units of in_key, below which
    a base step is no movement."""
    out_key: Any = "stalled_steps"
    """Entry of the count, int64 [*B, 1]."""
    _component_: str = "torchrl_hmcts.transforms.StallTransform"


@dataclass
class OptionRecorderConfig(TransformComponentConfig):
    """Keys of :class:`~torchrl_hmcts.transforms.OptionRecorder`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(OptionRecorderConfig(keys=["velocity", "action"])).position_key
        'position'
    """

    keys: Any = MISSING
    """Entries of a base transition to store, e.g. the in_keys of the loss: "velocity", "action",
    ("next", "velocity"). skill_key and displacement_key, under "next" too, are written by the
    recorder."""
    replay_buffer: Any = None
    """Extended at every macro-step."""
    position_key: Any = "position"
    """Entry [*B, D] whose displacement is measured."""
    displacement_key: Any = "displacement"
    """Displacement to write, [n, D] in the units of the position."""
    skill_key: Any = "skill"
    """Entry under which the OptionTransform tells the worker its option and under which it is
    stored, int64 [n]."""
    _component_: str = "torchrl_hmcts.transforms.OptionRecorder"
