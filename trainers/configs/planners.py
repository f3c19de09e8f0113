"""Configs of the planner and its parts, groups ``planner``, ``tree_policy``, ``novelty``, ..."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from torchrl_hmcts.trainers.configs.base import ComponentConfig


@dataclass
class MCTSPlannerConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.MCTSPlanner`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> instantiate(MCTSPlannerConfig(gamma=0.9, _partial_=True))(env=ChainEnv()).gamma
        0.9
    """

    env: Any = MISSING
    """The macro environment as simulator: any env under an OptionTransform, or any env with a
    discrete action, that is stateless (batch_locked=False, its state in the tensordict) or can be
    set to a state by reset(td, set_state=True)."""
    gamma: float | None = None
    """Discount per base step."""
    tree_policy: Any = None
    """UCT (default, c=1), PUCT, Gumbel, TorchRLScore, or a callable over NodeStatistics."""
    novelty: Any = None
    """Which new nodes are worth searching, e.g."""
    transpositions: Any = None
    """Which states are the same."""
    chance: Any = None
    """For a stochastic simulator, how often an option is simulated in a node."""
    leaf_evaluator: Any = None
    """Leaf_evaluator(td) -> values [m] or [m, 1] of new nodes, from their state and observation:
    ValueEvaluator, RolloutEvaluator, MixedEvaluator or your own."""
    option_prior: Any = None
    """Option_prior(td) -> probabilities [m, A]: ModulePrior or your own."""
    rollout: Any = None
    """From every new leaf go on for some options and keep them in the tree."""
    root_noise: Any = None
    """Noise in the prior of the roots."""
    backup: Any = None
    """MeanBackup or MaxBackup."""
    final_choice: Any = None
    """BestPlan, MostVisited, HighestValue or SampledVisits."""
    budget: Any = None
    """Limits per root."""
    expand: str = "all"
    """"all" simulates every option of a leaf at once, "one" only the option that the tree policy
    chooses, as in the textbook."""
    leaves_per_wave: int = 1
    """Leaves of each root that share a simulator call."""
    waves_in_flight: int = 1
    """Waves that are simulated at a time, the next one chosen before the outcomes of those before
    it are known."""
    exhausted: str = "skip"
    """What a descent does with an option behind which nothing is left to simulate: "skip" it
    (default: every simulation finds something new), or "revisit" it and back its known value up
    once more, at no simulator's cost, so that visits and mean values are those of the textbook."""
    duration_key: Any = "duration"
    """Entries of the env with the base steps of a step, int64 [*B, 1] (1 if the env has none), and
    the options that may be taken, bool [*B, A] (all if it has none)."""
    mask_key: Any = "action_mask"
    """Entries of the env with the base steps of a step, int64 [*B, 1] (1 if the env has none), and
    the options that may be taken, bool [*B, A] (all if it has none)."""
    reward_key: Any = None
    """Which reward, if the env has several."""
    seed: int | None = None
    """Of the planner's random numbers; every call moves on from it."""
    progress: Any = None
    """Called with a SearchProgress after every wave."""
    _component_: str = "torchrl_hmcts.planners.MCTSPlanner"


@dataclass
class UCTConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.UCT`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(UCTConfig(c=0.5))
        UCT(c=0.5)
    """

    c: float = 1.0
    """Exploration constant, in units of the return."""
    _component_: str = "torchrl_hmcts.planners.UCT"


@dataclass
class PUCTConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.PUCT`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(PUCTConfig(c=2.0))
        PUCT(c=2.0, unvisited_value=0.0, normalize=None, c_base=None)
    """

    c: float = 1.25
    """Exploration constant, in units of Q."""
    unvisited_value: float = 0.0
    """Q of an option without visits, where values are not normalised."""
    normalize: str | None = None
    """Scales Q to [0, 1], so that c needs no tuning to the size of the rewards: "siblings" by the
    lowest and highest value among the node and its options, "tree" by those of the whole tree so
    far."""
    c_base: float | None = None
    """Lets c grow with the visits of the node, its own evaluation included; null: constant."""
    _component_: str = "torchrl_hmcts.planners.PUCT"


@dataclass
class GumbelConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.Gumbel`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(GumbelConfig(max_considered=4))
        Gumbel(max_considered=4, c_visit=50.0, c_scale=0.1, scale=1.0)
    """

    max_considered: int = 16
    """Options considered at the root."""
    c_visit: float = 50.0
    """Visits that count before any are made, in the scale of the values."""
    c_scale: float = 0.1
    """Factor of the values' scale."""
    scale: float = 1.0
    """Of the Gumbel noise; 0 for a search without noise."""
    _component_: str = "torchrl_hmcts.planners.Gumbel"


@dataclass
class RadiusNoveltyConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.RadiusNovelty`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(RadiusNoveltyConfig(key="position", radius=0.6)).radius
        0.6
    """

    key: Any = MISSING
    """Entry or entries of the simulator's state or observation, [*B, f]."""
    radius: float = MISSING
    """In units of the (scaled) entries."""
    scale: Any = None
    """Factor of each entry."""
    relaxation: float = 0.75
    """Factor of the radius when a search is exhausted, in (0, 1)."""
    max_relaxations: int = 14
    """How often the radius of a search may be relaxed."""
    shorter_paths: bool = False
    """Accept states near others that are reached in fewer base steps."""
    shorter_by: float = 1.0
    """At most 1 and above 0: the share of the base steps that a shorter path may need at most."""
    _component_: str = "torchrl_hmcts.planners.RadiusNovelty"


@dataclass
class WidthNoveltyConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.WidthNovelty`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(WidthNoveltyConfig(key="position")).in_keys
        ['position']
    """

    key: Any = MISSING
    """Entry or entries of the simulator's state or observation, [*B, f], of an integer type or
    bool."""
    max_relaxations: int = 14
    """How often n may be raised for a search."""
    _component_: str = "torchrl_hmcts.planners.WidthNovelty"


@dataclass
class MeanBackupConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.MeanBackup`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(MeanBackupConfig())
        MeanBackup()
    """

    _component_: str = "torchrl_hmcts.planners.MeanBackup"


@dataclass
class MaxBackupConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.MaxBackup`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(MaxBackupConfig())
        MaxBackup()
    """

    _component_: str = "torchrl_hmcts.planners.MaxBackup"


@dataclass
class BestPlanConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.BestPlan`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(BestPlanConfig())
        BestPlan()
    """

    _component_: str = "torchrl_hmcts.planners.BestPlan"


@dataclass
class MostVisitedConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.MostVisited`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(MostVisitedConfig())
        MostVisited()
    """

    _component_: str = "torchrl_hmcts.planners.MostVisited"


@dataclass
class HighestValueConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.HighestValue`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(HighestValueConfig())
        HighestValue(random_ties=False)
    """

    random_ties: bool = False
    """Draw among options of equal value, as there are many where rewards are rare, instead of
    taking the one of lower index."""
    _component_: str = "torchrl_hmcts.planners.HighestValue"


@dataclass
class SampledVisitsConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.SampledVisits`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(SampledVisitsConfig(temperature=0.5))
        SampledVisits(temperature=0.5)
    """

    temperature: float = 1.0
    """Temperature: 0 is the most visited option, 1 draws in proportion to the visits."""
    _component_: str = "torchrl_hmcts.planners.SampledVisits"


@dataclass
class SearchBudgetConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.SearchBudget`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(SearchBudgetConfig(simulations=64)).simulations
        64
    """

    expansions: int | None = None
    """Nodes whose options are simulated (with expand="one": options simulated)."""
    simulations: int | None = None
    """Values backed up: an option simulated, or a known leaf visited once more."""
    base_steps: int | None = None
    """Simulated base steps."""
    seconds: float | None = None
    """Wall time of the whole call."""
    nodes: int | None = None
    """Nodes in the tree."""
    until_plan: bool = True
    """Stop at the first plan that earns a reward."""
    improve_expansions: int = 0
    """Expansions after the first plan, to find better ones."""
    _component_: str = "torchrl_hmcts.planners.SearchBudget"


@dataclass
class DirichletNoiseConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.DirichletNoise`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(DirichletNoiseConfig()).fraction
        0.25
    """

    alpha: float = 0.3
    """Of the Dirichlet distribution, about 10 over the number of options."""
    fraction: float = 0.25
    """Share of the noise in the root's prior."""
    _component_: str = "torchrl_hmcts.planners.DirichletNoise"


@dataclass
class ProgressiveWideningConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.ProgressiveWidening`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(ProgressiveWideningConfig())
        ProgressiveWidening(k=1.0, alpha=0.5)
    """

    k: float = 1.0
    """Outcomes of an option at its first visit."""
    alpha: float = 0.5
    """Growth of the number of outcomes with the visits."""
    _component_: str = "torchrl_hmcts.planners.ProgressiveWidening"


@dataclass
class TranspositionsConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.Transpositions`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(TranspositionsConfig(key="position"))
        Transpositions(['position'])
    """

    key: Any = MISSING
    """Entry or entries that make up the state, e.g. "player_tile"."""
    _component_: str = "torchrl_hmcts.planners.Transpositions"


@dataclass
class ValueEvaluatorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.ValueEvaluator`.

    Example:
        >>> from hydra.utils import instantiate
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> value = TensorDictModule(torch.nn.Linear(2, 1), ["position"], ["state_value"])
        >>> instantiate(ValueEvaluatorConfig(_partial_=True))(module=value).in_keys
        ['position']
    """

    module: Any = MISSING
    """A TensorDictModule whose inputs are entries of the macro environment."""
    value_key: Any = "state_value"
    """Its output to use, [m, 1] or [m]."""
    _component_: str = "torchrl_hmcts.planners.ValueEvaluator"


@dataclass
class RolloutEvaluatorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.RolloutEvaluator`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(RolloutEvaluatorConfig())
        RolloutEvaluator(policy=None, max_options=10, num_rollouts=1, bootstrap=None)
    """

    policy: Any = None
    """Policy(td) -> probabilities [m, A] of the options, e.g."""
    max_options: int = 10
    """Options of a rollout at most."""
    num_rollouts: int = 1
    """Rollouts from each state, of which the mean is taken."""
    bootstrap: Any = None
    """Evaluator of the state in which a rollout was cut off: by max_options, a truncation, or a
    state without an option that may be taken."""
    _component_: str = "torchrl_hmcts.planners.RolloutEvaluator"


@dataclass
class MixedEvaluatorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.MixedEvaluator`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.planners import RolloutEvaluator
        >>> instantiate(MixedEvaluatorConfig(weight=0.25, _partial_=True))(
        ...     first=RolloutEvaluator(8), second=RolloutEvaluator(2)).weight
        0.25
    """

    first: Any = MISSING
    """First evaluator."""
    second: Any = MISSING
    """Second evaluator."""
    weight: float = 0.5
    """Weight of the second evaluator, in [0, 1]."""
    _component_: str = "torchrl_hmcts.planners.MixedEvaluator"


@dataclass
class ModulePriorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.ModulePrior`.

    Example:
        >>> from hydra.utils import instantiate
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> policy = TensorDictModule(torch.nn.Linear(2, 4), ["position"], ["logits"])
        >>> instantiate(ModulePriorConfig(_partial_=True))(module=policy).in_keys
        ['position']
    """

    module: Any = MISSING
    """A TensorDictModule that writes probabilities or logits [m, A]."""
    prob_key: Any = None
    """Its output with probabilities."""
    logits_key: Any = None
    """Its output with logits, of which the softmax is taken."""
    _component_: str = "torchrl_hmcts.planners.ModulePrior"


@dataclass
class PolicyValueEvaluatorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.PolicyValueEvaluator`.

    Example:
        >>> from hydra.utils import instantiate
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> both = TensorDictModule(
        ...     lambda x: (x, x.sum(-1, keepdim=True)), ["position"], ["logits", "state_value"])
        >>> instantiate(PolicyValueEvaluatorConfig(_partial_=True))(module=both).in_keys
        ['position']
    """

    module: Any = MISSING
    """Network that writes logits and value of a state."""
    temperature: float = 1.0
    """Temperature of the prior, above 0."""
    uniform_share: float = 0.0
    """How much, in [0, 1], of the prior is spread over all options, so that none is ruled
    out by a network that is too sure."""
    logits_key: Any = "logits"
    """Entry of the logits."""
    value_key: Any = "state_value"
    """Entry of the value."""
    _component_: str = "torchrl_hmcts.planners.PolicyValueEvaluator"


@dataclass
class TorchRLScoreConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.TorchRLScore`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl.modules.mcts import PUCTScore
        >>> instantiate(TorchRLScoreConfig(_partial_=True))(score_module=PUCTScore(c=1.25))
        TorchRLScore(PUCTScore)
    """

    score_module: Any = MISSING
    """One of torchrl.modules.mcts, or any module that writes its scores."""
    _component_: str = "torchrl_hmcts.planners.TorchRLScore"


@dataclass
class HierarchicalPolicyConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.HierarchicalPolicy`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> instantiate(HierarchicalPolicyConfig(_partial_=True))(
        ...     planner=MCTSPlanner(ChainEnv())).out_keys
        ['action', 'plan', 'plan_length', 'plan_step', 'num_plans']
    """

    planner: Any = MISSING
    """The manager."""
    max_plan_length: int = 64
    """Options of a plan that are kept, L."""
    replan_every: int | None = None
    """Options after which to plan again though the plan goes on; 1 for every option."""
    divergence: float | None = None
    """Distance from the predicted state, in units of the entries, above which to plan again."""
    divergence_key: Any = None
    """Entries of the simulator's state or observation that are compared, e.g. "position"."""
    reuse: bool = False
    """Keep the trees between decisions."""
    _component_: str = "torchrl_hmcts.planners.HierarchicalPolicy"


@dataclass
class ModelBasedControlConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.ModelBasedControl`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> instantiate(ModelBasedControlConfig(_partial_=True))(
        ...     planner=MCTSPlanner(ChainEnv())).out_keys
        ['action', 'plan', 'plan_length', 'plan_step', 'num_plans']
    """

    planner: Any = MISSING
    """Over the model, a macro env that can be set to any state."""
    state_map: Any = None
    """State_map(td) -> TensorDict [*B] of what the planner reads (its in_keys), from the entries of
    the real env."""
    env: Any = None
    """The real macro env, checked once against the model's options."""
    replan_every: int | None = 1
    """Options after which a new plan is made."""
    max_plan_length: int = 64
    """As of HierarchicalPolicy."""
    _component_: str = "torchrl_hmcts.planners.ModelBasedControl"


@dataclass
class GoalPlannerConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.GoalPlanner`.

    Example:
        >>> GoalPlannerConfig(goal_key="place").goal_key
        'place'
    """

    planner: Any = MISSING
    """The manager, over the macro environment."""
    to_macro: Any = MISSING
    """To_macro(td [m]) -> td [m], the macro environment's state for a state of the worker's
    environment."""
    goal_key: Any = "position"
    """Entry [m, D] or [m] of the macro environment's state or observation that is the goal."""
    in_keys: Any = None
    """Entries that to_macro reads."""
    _component_: str = "torchrl_hmcts.planners.GoalPlanner"


@dataclass
class TreeRolloutConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.planners.TreeRollout`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(TreeRolloutConfig())
        TreeRollout(max_options=10)
    """

    max_options: int = 10
    """Options of a rollout at most."""
    _component_: str = "torchrl_hmcts.planners.TreeRollout"
