"""Configs of every swappable class, in Hydra's store beside TorchRL's own groups.

Each is a dataclass with the keywords and defaults of its class (a test compares both ways) and a
sentence below each; :func:`to_yaml` writes one as yaml.

Example:
    >>> from hydra import compose, initialize
    >>> from hydra.utils import instantiate
    >>> from torchrl_hmcts.testing import ChainEnv
    >>> with initialize(version_base=None):
    ...     config = compose(overrides=["+planner=mcts", "+tree_policy=puct"])
    >>> planner = instantiate(config.planner, _partial_=True)(env=ChainEnv(length=5))
    >>> planner.tree_policy.c
    1.25
"""

from __future__ import annotations

from torchrl_hmcts.trainers.configs.base import (
    ComponentConfig,
    EnvComponentConfig,
    LossComponentConfig,
    TransformComponentConfig,
    build,
    to_yaml,
)
from torchrl_hmcts.trainers.configs.envs import (
    AtariRAMEnvConfig,
    GridworldMazeEnvConfig,
    LabMazeEnvConfig,
    StatelessSimulatorConfig,
    WaterworldMazeEnvConfig,
)
from torchrl_hmcts.trainers.configs.losses import (
    A3CLossConfig,
    ContinuousDIAYNLossConfig,
    DIAYNLossConfig,
    DiscreteSkillSACLossConfig,
    ExpertIterationLossConfig,
    IntraOptionQLossConfig,
    OptionModelLossConfig,
    OptionTerminationLossConfig,
    SkillPriorLossConfig,
    SkillSACLossConfig,
)
from torchrl_hmcts.trainers.configs.modules import (
    FixedSkillPriorConfig,
    GaussianSkillActorConfig,
    GrowingSkillPriorConfig,
    LearnedSkillPriorConfig,
    LearnedTerminationConfig,
    SkillActionCriticConfig,
    SkillActorConfig,
    SkillCriticConfig,
    SkillDiscriminatorConfig,
    SkillDynamicsConfig,
    SkillEncoderConfig,
    SkillPolicyConfig,
    StallTerminationConfig,
    TerminationNetworkConfig,
)
from torchrl_hmcts.trainers.configs.objectives import (
    LSDEncoderLossConfig,
    METRAEncoderLossConfig,
    SkillDiscriminatorLossConfig,
    SkillDynamicsLossConfig,
)
from torchrl_hmcts.trainers.configs.planners import (
    BestPlanConfig,
    DirichletNoiseConfig,
    GoalPlannerConfig,
    GumbelConfig,
    HierarchicalPolicyConfig,
    HighestValueConfig,
    MaxBackupConfig,
    MCTSPlannerConfig,
    MeanBackupConfig,
    MixedEvaluatorConfig,
    ModelBasedControlConfig,
    ModulePriorConfig,
    MostVisitedConfig,
    PolicyValueEvaluatorConfig,
    ProgressiveWideningConfig,
    PUCTConfig,
    RadiusNoveltyConfig,
    RolloutEvaluatorConfig,
    SampledVisitsConfig,
    SearchBudgetConfig,
    TorchRLScoreConfig,
    TranspositionsConfig,
    TreeRolloutConfig,
    UCTConfig,
    ValueEvaluatorConfig,
    WidthNoveltyConfig,
)
from torchrl_hmcts.trainers.configs.store import GROUPS, register_configs
from torchrl_hmcts.trainers.configs.trainers import (
    A3CTrainerConfig,
    DIAYNTrainerConfig,
    HMCTSTrainerConfig,
)
from torchrl_hmcts.trainers.configs.transforms import (
    DIAYNRewardConfig,
    DisplacementTransformConfig,
    OptionRecorderConfig,
    OptionTransformConfig,
    SkillMaskTransformConfig,
    SkillRewardConfig,
    SkillTransformConfig,
    StallTransformConfig,
    SubgoalTransformConfig,
)

register_configs()

__all__ = [
    "A3CLossConfig",
    "A3CTrainerConfig",
    "AtariRAMEnvConfig",
    "BestPlanConfig",
    "ComponentConfig",
    "ContinuousDIAYNLossConfig",
    "DIAYNLossConfig",
    "DIAYNRewardConfig",
    "DIAYNTrainerConfig",
    "DirichletNoiseConfig",
    "DiscreteSkillSACLossConfig",
    "DisplacementTransformConfig",
    "EnvComponentConfig",
    "ExpertIterationLossConfig",
    "FixedSkillPriorConfig",
    "GROUPS",
    "GaussianSkillActorConfig",
    "GoalPlannerConfig",
    "GridworldMazeEnvConfig",
    "GrowingSkillPriorConfig",
    "GumbelConfig",
    "HMCTSTrainerConfig",
    "HierarchicalPolicyConfig",
    "HighestValueConfig",
    "IntraOptionQLossConfig",
    "LSDEncoderLossConfig",
    "LabMazeEnvConfig",
    "LearnedSkillPriorConfig",
    "LearnedTerminationConfig",
    "LossComponentConfig",
    "MCTSPlannerConfig",
    "METRAEncoderLossConfig",
    "MaxBackupConfig",
    "MeanBackupConfig",
    "MixedEvaluatorConfig",
    "ModelBasedControlConfig",
    "ModulePriorConfig",
    "MostVisitedConfig",
    "OptionModelLossConfig",
    "OptionRecorderConfig",
    "OptionTerminationLossConfig",
    "OptionTransformConfig",
    "PUCTConfig",
    "PolicyValueEvaluatorConfig",
    "ProgressiveWideningConfig",
    "RadiusNoveltyConfig",
    "RolloutEvaluatorConfig",
    "SampledVisitsConfig",
    "SearchBudgetConfig",
    "SkillActionCriticConfig",
    "SkillActorConfig",
    "SkillCriticConfig",
    "SkillDiscriminatorConfig",
    "SkillDiscriminatorLossConfig",
    "SkillDynamicsConfig",
    "SkillDynamicsLossConfig",
    "SkillEncoderConfig",
    "SkillMaskTransformConfig",
    "SkillPolicyConfig",
    "SkillPriorLossConfig",
    "SkillRewardConfig",
    "SkillSACLossConfig",
    "SkillTransformConfig",
    "StallTerminationConfig",
    "StallTransformConfig",
    "StatelessSimulatorConfig",
    "SubgoalTransformConfig",
    "TerminationNetworkConfig",
    "TorchRLScoreConfig",
    "TransformComponentConfig",
    "TranspositionsConfig",
    "TreeRolloutConfig",
    "UCTConfig",
    "ValueEvaluatorConfig",
    "WaterworldMazeEnvConfig",
    "WidthNoveltyConfig",
    "build",
    "register_configs",
    "to_yaml",
]
