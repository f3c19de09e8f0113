"""Configs of every swappable class, in Hydra's store beside TorchRL's own groups.

A config is made from the signature of its class: the same keywords, the same defaults. The meaning
of a keyword stands in the docstring of the class, from which :func:`to_yaml` takes it.

Parts of a planner and of a loss go to their places by themselves: after ``planner=mcts``,
``tree_policy=puct`` is ``planner.tree_policy``; after ``loss=discrete_skill_sac``,
``objective=metra`` is ``loss.objective``. Another place is named: ``tree_policy@my.place=puct``.

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

import dataclasses
import functools
import importlib
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any

import torch
import torchrl.trainers.algorithms.configs  # noqa: F401  fills the store with TorchRL's own
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf
from torchrl.trainers.algorithms.configs.common import ConfigBase
from torchrl.trainers.algorithms.configs.envs import EnvConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig
from torchrl.trainers.algorithms.configs.transforms import TransformConfig

from torchrl_hmcts.trainers.experiments.registry import ALL_EXPERIMENTS

_TARGET = "torchrl_hmcts.trainers.configs.build"
_PLAIN = (bool, int, float, str)  # types that Hydra checks; any other may be a config or a list

_PACKAGES: Mapping[str, Mapping[str, Mapping[str, str]]] = {
    "torchrl_hmcts.objectives": {
        "loss": {
            "a3c": "A3CLoss",
            "diayn": "DIAYNLoss",
            "discrete_skill_sac": "DiscreteSkillSACLoss",
            "expert_iteration": "ExpertIterationLoss",
            "intra_option_q": "IntraOptionQLoss",
            "option_model": "OptionModelLoss",
            "option_termination": "OptionTerminationLoss",
            "skill_prior": "SkillPriorLoss",
            "skill_sac": "SkillSACLoss",
        },
        "objective": {
            "dads": "SkillDynamicsLoss",
            "diayn": "SkillDiscriminatorLoss",
            "lsd": "LSDEncoderLoss",
            "metra": "METRAEncoderLoss",
        },
    },
    "torchrl_hmcts.transforms": {
        "transform": {
            "displacement": "DisplacementTransform",
            "option": "OptionTransform",
            "option_recorder": "OptionRecorder",
            "skill": "SkillTransform",
            "skill_mask": "SkillMaskTransform",
            "skill_reward": "SkillReward",
            "stall": "StallTransform",
            "subgoal": "SubgoalTransform",
        },
    },
    "torchrl_hmcts.planners": {
        "planner": {"mcts": "MCTSPlanner"},
        "tree_policy": {
            "gumbel": "Gumbel",
            "puct": "PUCT",
            "torchrl_score": "TorchRLScore",
            "uct": "UCT",
        },
        "novelty": {"radius": "RadiusNovelty", "width": "WidthNovelty"},
        "final_choice": {
            "best_plan": "BestPlan",
            "highest_value": "HighestValue",
            "most_visited": "MostVisited",
            "sampled_visits": "SampledVisits",
        },
        "budget": {"search": "SearchBudget"},
        "root_noise": {"dirichlet": "DirichletNoise"},
        "chance": {"progressive_widening": "ProgressiveWidening"},
        "transpositions": {"by_key": "Transpositions"},
        "leaf_evaluator": {
            "mixed": "MixedEvaluator",
            "policy_value": "PolicyValueEvaluator",
            "rollout": "RolloutEvaluator",
            "value": "ValueEvaluator",
        },
        "rollout": {"tree": "TreeRollout"},
        "option_prior": {"module": "ModulePrior"},
        "control": {
            "goals": "GoalPlanner",
            "hierarchical": "HierarchicalPolicy",
        },
    },
    "torchrl_hmcts.modules": {
        "model": {
            "skill_action_critic": "SkillActionCritic",
            "skill_actor": "SkillActor",
            "skill_critic": "SkillCritic",
            "skill_discriminator": "SkillDiscriminator",
            "skill_dynamics": "SkillDynamics",
            "skill_encoder": "SkillEncoder",
            "skill_policy": "SkillPolicy",
            "termination_network": "TerminationNetwork",
        },
        "skill_prior": {
            "fixed": "FixedSkillPrior",
            "growing": "GrowingSkillPrior",
            "learned": "LearnedSkillPrior",
        },
        "termination": {"learned": "LearnedTermination", "stall": "StallTermination"},
    },
    "torchrl_hmcts.envs": {
        "env": {
            "atari_ram": "AtariRAMEnv",
            "gridworld": "GridworldMazeEnv",
            "labmaze": "LabMazeEnv",
            "settable_gym": "SettableGymEnv",
            "stateless": "StatelessSimulator",
            "waterworld": "WaterworldMazeEnv",
        },
    },
    "torchrl_hmcts.trainers": {
        "trainer": {"a3c": "A3CTrainer", "diayn": "DIAYNTrainer", "hmcts": "HMCTSTrainer"},
        "hook": {"skill_reward": "SkillRewardHook"},
    },
    "torchrl.data": {
        "action_spec": {
            "bounded": "Bounded",
            "categorical": "Categorical",
            "one_hot": "OneHot",
        },
    },
}
COMPONENTS: Mapping[str, Mapping[str, str]] = {
    group: {name: f"{package}.{component}" for name, component in names.items()}
    for package, groups in _PACKAGES.items()
    for group, names in groups.items()
}
"""Classes with a config, as dotted paths by group and name."""

_PLACES = {part: f"planner.{part}" for part in _PACKAGES["torchrl_hmcts.planners"]} | {
    "planner": "planner",
    "control": "control",
    "objective": "loss.objective",
}


@dataclasses.dataclass
class ComponentConfig(ConfigBase):
    """A config from which ``hydra.utils.instantiate`` builds a component.

    ``_component_`` is the path of its class, whose keywords are the other fields. With
    ``_partial_=True`` the result is a function of the keywords that are still missing. Pass envs
    and networks to that function: Hydra would copy them.
    """

    _target_: str = _TARGET
    _partial_: bool = False

    def __post_init__(self) -> None:
        """Check nothing: the component checks its arguments when it is built."""


_BASES = {"loss": LossConfig, "transform": TransformConfig, "env": EnvConfig}


@functools.cache
def config_of(component: type, base: type = ComponentConfig) -> Any:
    """Make the config of a class from its signature.

    Args:
        component: class whose constructor is configured.
        base: dataclass to inherit from. Default: :class:`ComponentConfig`.

    Returns:
        A dataclass. Its fields are the keywords of the constructor; a required one is ``MISSING``.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.planners import UCT
        >>> instantiate(config_of(UCT)(c=0.5))
        UCT(c=0.5)
    """
    path = _public_path(component)
    hints = _hints(component)
    fields: list[Any] = [
        (name, hints.get(name, Any), _as_field(parameter.default))
        for name, parameter in _keywords(component).items()
    ]
    fields += [("_component_", str, path), ("_target_", str, _TARGET)]
    made = dataclasses.make_dataclass(f"{component.__name__}Config", fields, bases=(base,))
    made.__module__ = __name__
    made.__doc__ = f"Keys of :class:`~{path}`."
    return made


def build(_component_: str, **keywords: Any) -> Any:
    """Build a component from the entries of its config.

    Lists become tuples where the keyword is a (nested) key. Names become what they name where the
    default is a class or function, e.g. ``activation="torch.nn.Tanh"``. A loss that calls its
    critic ``qvalue_network`` also takes it as ``critic_network``, as TorchRL's trainer configs
    pass it.

    Args:
        _component_: path of its class, e.g. ``"torchrl_hmcts.planners.UCT"``.
        **keywords: of the class.

    Returns:
        The component.

    Example:
        >>> build("torchrl_hmcts.planners.UCT", c=0.5)
        UCT(c=0.5)
    """
    component = named(_component_)
    parameters = _keywords(component)
    if "critic_network" not in parameters and "qvalue_network" in parameters:
        critic = keywords.pop("critic_network", None)
        if critic is not None:
            keywords["qvalue_network"] = critic
    return component(
        **{name: _typed(value, parameters.get(name)) for name, value in keywords.items()}
    )


def named(path: str) -> Any:
    """Return what a dotted path names.

    Args:
        path: e.g. ``"torch.nn.ReLU"``.

    Example:
        >>> named("torch.nn.ReLU").__name__
        'ReLU'
    """
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


def to_yaml(component: type) -> str:
    """Write the config of a class as yaml: every key with its default, its meaning above it.

    Args:
        component: class with a config.

    Example:
        >>> from torchrl_hmcts.planners import UCT
        >>> print(to_yaml(UCT))
        # exploration constant, in units of the return. Default ``1.0``.
        c: 1.0
        _target_: torchrl_hmcts.trainers.configs.build
        _component_: torchrl_hmcts.planners.UCT
        <BLANKLINE>
    """
    meanings = argument_docs(component)
    parts = []
    fields = [f for f in dataclasses.fields(config_of(component)) if f.name != "_partial_"]
    for field in sorted(fields, key=lambda f: f.name.startswith("_")):
        if field.name in meanings:
            parts.append(textwrap.indent(textwrap.fill(meanings[field.name], 96), "# "))
        factory = field.default_factory
        value = field.default if factory is dataclasses.MISSING else factory()
        parts.append(OmegaConf.to_yaml({field.name: value}).rstrip())
    return "\n".join(parts) + "\n"


def argument_docs(component: type) -> dict[str, str]:
    """Return the meaning of each argument from the docstrings of a class and those it extends.

    Args:
        component: class whose docstring has a section ``Args:``.

    Example:
        >>> from torchrl_hmcts.planners import UCT
        >>> argument_docs(UCT)
        {'c': 'exploration constant, in units of the return. Default ``1.0``.'}
    """
    docs: dict[str, str] = {}
    entry = r"^(\w+(?:, \w+)*)(?: \([^\n]*?\))?: (.*?)(?=^\w|\Z)"
    for cls in reversed(component.__mro__):
        text = inspect.cleandoc(vars(cls).get("__doc__") or "")
        section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", text, re.MULTILINE | re.DOTALL)
        body = textwrap.dedent(section[1]) if section else ""
        for names, meaning in re.findall(entry, body, re.MULTILINE | re.DOTALL):
            docs.update(dict.fromkeys(names.split(", "), " ".join(meaning.split())))
    return docs


def register_configs() -> None:
    """Put all configs into Hydra's store; importing ``torchrl_hmcts.trainers.configs`` does it.

    A class whose package is not installed (``ale_py`` for Atari) is left out.

    Example:
        >>> from hydra.core.config_store import ConfigStore
        >>> register_configs()
        >>> "puct.yaml" in ConfigStore.instance().list("tree_policy")
        True
    """
    store = ConfigStore.instance()
    for group, names in COMPONENTS.items():
        for name, path in names.items():
            try:
                component = named(path)
            except ModuleNotFoundError:
                continue
            node = config_of(component, _BASES.get(group, ComponentConfig))
            store.store(group=group, name=name, node=node, package=_PLACES.get(group))
    for name, experiment in ALL_EXPERIMENTS.items():
        store.store(group="experiment", name=name, node=experiment.config_class)


def _public_path(component: type) -> str:
    """The path under which the package exports a class, not that of the file that defines it."""
    parts = component.__module__.split(".")
    for end in range(1, len(parts)):
        package = ".".join(parts[:end])
        if getattr(importlib.import_module(package), component.__name__, None) is component:
            return f"{package}.{component.__name__}"
    return f"{component.__module__}.{component.__qualname__}"


_VARIABLE = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def _constructors(component: type) -> Iterator[Any]:
    """The constructor of a class, and where it takes ``**keywords`` those that it hands them to."""
    for cls in component.__mro__:
        init = vars(cls).get("__init__")
        if init is None:
            continue
        if cls is not component and not cls.__module__.startswith("torchrl_hmcts"):
            return
        yield init
        kinds = [parameter.kind for parameter in inspect.signature(init).parameters.values()]
        if inspect.Parameter.VAR_KEYWORD not in kinds:
            return


def _keywords(component: type) -> dict[str, inspect.Parameter]:
    """The parameters of a constructor that have a name of their own."""
    found: dict[str, inspect.Parameter] = {}
    for init in _constructors(component):
        for name, parameter in inspect.signature(init).parameters.items():
            if name != "self" and parameter.kind not in _VARIABLE:
                found.setdefault(name, parameter)
    return found


def _hints(component: type) -> dict[str, Any]:
    """The annotations that Hydra can check: plain types and None; others are left to the class."""
    checked = {}
    for init in _constructors(component):
        try:
            hints = typing.get_type_hints(init)
        except NameError:  # a name that only type checkers import
            continue
        for name, hint in hints.items():
            parts = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
            plain = [part for part in parts if part is not types.NoneType]
            if len(plain) == 1 and plain[0] in _PLAIN:
                checked.setdefault(name, hint)
    return checked


def _as_field(default: Any) -> Any:
    """A default as a config can hold it: classes by name, sequences as lists."""
    if default is inspect.Parameter.empty:
        return MISSING
    value = _as_plain(default)
    if isinstance(value, list | dict):
        return dataclasses.field(default_factory=functools.partial(_as_plain, default))
    return value


def _as_plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _as_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list | range):
        return [_as_plain(item) for item in value]
    if isinstance(value, torch.dtype):
        return str(value)
    if callable(value):
        return f"{value.__module__}.{value.__qualname__}"
    return value


def _typed(value: Any, parameter: inspect.Parameter | None) -> Any:
    """A value of a config as the parameter takes it."""
    if isinstance(value, DictConfig | ListConfig):
        value = OmegaConf.to_container(value, resolve=True)
    if parameter is None:
        return value
    default = parameter.default
    is_name = default is not inspect.Parameter.empty and (
        callable(default) or isinstance(default, torch.dtype)
    )
    kind = str(parameter.annotation)
    if isinstance(value, list) and "NestedKey" in kind:
        if "Sequence[NestedKey]" in kind:
            return [tuple(key) if isinstance(key, list) else key for key in value]
        return tuple(value)
    if isinstance(value, str) and is_name:
        return named(value)
    return value


register_configs()
