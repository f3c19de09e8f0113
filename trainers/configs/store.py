"""The configs in Hydra's store, in the groups of TorchRL's own and some of ours.

Parts of a planner and of a loss go to their places by themselves: after ``planner=mcts``,
``tree_policy=puct`` is ``planner.tree_policy``; after ``loss=discrete_skill_sac``,
``objective=metra`` is ``loss.objective``. Elsewhere say where: ``tree_policy@my.place=puct``.
"""

from __future__ import annotations

from collections.abc import Mapping

import torchrl.trainers.algorithms.configs  # noqa: F401  fills the store with TorchRL's own
from hydra.core.config_store import ConfigStore

from torchrl_hmcts.trainers.configs import (
    envs,
    losses,
    modules,
    objectives,
    planners,
    trainers,
    transforms,
)
from torchrl_hmcts.trainers.experiments.registry import ALL_EXPERIMENTS

GROUPS: Mapping[str, Mapping[str, type]] = {
    "loss": {
        "a3c": losses.A3CLossConfig,
        "continuous_diayn": losses.ContinuousDIAYNLossConfig,
        "diayn": losses.DIAYNLossConfig,
        "discrete_skill_sac": losses.DiscreteSkillSACLossConfig,
        "expert_iteration": losses.ExpertIterationLossConfig,
        "intra_option_q": losses.IntraOptionQLossConfig,
        "option_model": losses.OptionModelLossConfig,
        "option_termination": losses.OptionTerminationLossConfig,
        "skill_prior": losses.SkillPriorLossConfig,
        "skill_sac": losses.SkillSACLossConfig,
    },
    "objective": {
        "dads": objectives.SkillDynamicsLossConfig,
        "diayn": objectives.SkillDiscriminatorLossConfig,
        "lsd": objectives.LSDEncoderLossConfig,
        "metra": objectives.METRAEncoderLossConfig,
    },
    "transform": {
        "diayn_reward": transforms.DIAYNRewardConfig,
        "displacement": transforms.DisplacementTransformConfig,
        "option": transforms.OptionTransformConfig,
        "option_recorder": transforms.OptionRecorderConfig,
        "skill": transforms.SkillTransformConfig,
        "skill_mask": transforms.SkillMaskTransformConfig,
        "skill_reward": transforms.SkillRewardConfig,
        "stall": transforms.StallTransformConfig,
        "subgoal": transforms.SubgoalTransformConfig,
    },
    "planner": {"mcts": planners.MCTSPlannerConfig},
    "tree_policy": {
        "gumbel": planners.GumbelConfig,
        "puct": planners.PUCTConfig,
        "torchrl_score": planners.TorchRLScoreConfig,
        "uct": planners.UCTConfig,
    },
    "novelty": {
        "radius": planners.RadiusNoveltyConfig,
        "width": planners.WidthNoveltyConfig,
    },
    "backup": {"max": planners.MaxBackupConfig, "mean": planners.MeanBackupConfig},
    "final_choice": {
        "best_plan": planners.BestPlanConfig,
        "highest_value": planners.HighestValueConfig,
        "most_visited": planners.MostVisitedConfig,
        "sampled_visits": planners.SampledVisitsConfig,
    },
    "budget": {"search": planners.SearchBudgetConfig},
    "root_noise": {"dirichlet": planners.DirichletNoiseConfig},
    "chance": {"progressive_widening": planners.ProgressiveWideningConfig},
    "transpositions": {"by_key": planners.TranspositionsConfig},
    "leaf_evaluator": {
        "mixed": planners.MixedEvaluatorConfig,
        "policy_value": planners.PolicyValueEvaluatorConfig,
        "rollout": planners.RolloutEvaluatorConfig,
        "value": planners.ValueEvaluatorConfig,
    },
    "rollout": {"tree": planners.TreeRolloutConfig},
    "option_prior": {"module": planners.ModulePriorConfig},
    "control": {
        "goals": planners.GoalPlannerConfig,
        "hierarchical": planners.HierarchicalPolicyConfig,
        "model_based": planners.ModelBasedControlConfig,
    },
    "model": {
        "gaussian_skill_actor": modules.GaussianSkillActorConfig,
        "skill_action_critic": modules.SkillActionCriticConfig,
        "skill_actor": modules.SkillActorConfig,
        "skill_critic": modules.SkillCriticConfig,
        "skill_discriminator": modules.SkillDiscriminatorConfig,
        "skill_dynamics": modules.SkillDynamicsConfig,
        "skill_encoder": modules.SkillEncoderConfig,
        "skill_policy": modules.SkillPolicyConfig,
        "termination_network": modules.TerminationNetworkConfig,
    },
    "skill_prior": {
        "fixed": modules.FixedSkillPriorConfig,
        "growing": modules.GrowingSkillPriorConfig,
        "learned": modules.LearnedSkillPriorConfig,
    },
    "termination": {
        "learned": modules.LearnedTerminationConfig,
        "stall": modules.StallTerminationConfig,
    },
    "env": {
        "atari_ram": envs.AtariRAMEnvConfig,
        "gridworld": envs.GridworldMazeEnvConfig,
        "labmaze": envs.LabMazeEnvConfig,
        "stateless": envs.StatelessSimulatorConfig,
        "waterworld": envs.WaterworldMazeEnvConfig,
    },
    "trainer": {
        "a3c": trainers.A3CTrainerConfig,
        "diayn": trainers.DIAYNTrainerConfig,
        "hmcts": trainers.HMCTSTrainerConfig,
    },
}
"""The configs by group and name."""

_PARTS_OF_PLANNER = (
    "tree_policy",
    "novelty",
    "backup",
    "final_choice",
    "budget",
    "root_noise",
    "chance",
    "transpositions",
    "leaf_evaluator",
    "option_prior",
    "rollout",
)
_PLACES = {part: f"planner.{part}" for part in _PARTS_OF_PLANNER} | {"objective": "loss.objective"}


def register_configs() -> None:
    """Put all configs into Hydra's store; importing ``torchrl_hmcts.trainers.configs`` does it.

    Example:
        >>> from hydra.core.config_store import ConfigStore
        >>> register_configs()
        >>> "puct.yaml" in ConfigStore.instance().list("tree_policy")
        True
    """
    store = ConfigStore.instance()
    for group, configs in GROUPS.items():
        for name, config in configs.items():
            store.store(group=group, name=name, node=config, package=_PLACES.get(group))
    for name, experiment in ALL_EXPERIMENTS.items():
        store.store(group="experiment", name=name, node=experiment.config_class)
