"""Configs of every swappable class, in Hydra's store beside TorchRL's own groups.

A config has the keywords and defaults of the signature of its class. Parts of a planner and of a
loss go to their places: after ``planner=mcts``, ``tree_policy=puct`` is ``planner.tree_policy``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import re
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torchrl.trainers.algorithms.configs  # noqa: F401  fills the store with TorchRL's own
from hydra import compose, initialize
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torchrl.trainers.algorithms.configs.common import ConfigBase
from torchrl.trainers.algorithms.configs.envs import EnvConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig
from torchrl.trainers.algorithms.configs.transforms import TransformConfig

from torchrl_hmcts.trainers.experiments.registry import ALL_EXPERIMENTS
from torchrl_hmcts.trainers.parts import constructors, keywords_of, named
from torchrl_hmcts.trainers.runs.config import unknown_key

_TARGET = "torchrl_hmcts.trainers.parts.build"
_INTERNAL = ("_target_", "_partial_")
_PLAIN = (bool, int, float, str)  # types that Hydra checks; any other may be a config or a list

# Classes by group. Where no name is given, it is that of the class in snake case, less the group.
_PACKAGES: Mapping[str, Mapping[str, str]] = {
    "torchrl_hmcts.objectives": {
        "loss": "A3CLoss DIAYNLoss DiscreteSkillSACLoss ExpertIterationLoss "
        "GoalCloningLoss IntraOptionQLoss OptionModelLoss OptionTerminationLoss SkillPriorLoss "
        "SkillSACLoss",
        "objective": "dads=SkillDynamicsLoss diayn=SkillDiscriminatorLoss lsd=LSDEncoderLoss "
        "metra=METRAEncoderLoss",
    },
    "torchrl_hmcts.transforms": {
        "transform": "DisplacementTransform OptionTransform "
        "OptionRecorder SkillTransform SkillMaskTransform skill_reward=SkillReward StallTransform "
        "SubgoalTransform",
    },
    "torchrl_hmcts.planners": {
        "planner": "mcts=MCTSPlanner",
        "tree_policy": "Gumbel PUCT torchrl_score=TorchRLScore UCT",
        "novelty": "radius=RadiusNovelty width=WidthNovelty",
        "final_choice": "BestPlan HighestValue MostVisited SampledVisits",
        "budget": "search=SearchBudget",
        "root_noise": "dirichlet=DirichletNoise",
        "chance": "ProgressiveWidening",
        "transpositions": "by_key=Transpositions",
        "leaf_evaluator": "mixed=MixedEvaluator policy_value=PolicyValueEvaluator "
        "rollout=RolloutEvaluator value=ValueEvaluator",
        "rollout": "tree=TreeRollout",
        "option_prior": "module=ModulePrior",
        "control": "goals=GoalPlanner hierarchical=HierarchicalPolicy",
    },
    "torchrl_hmcts.modules": {
        "model": "SkillActionCritic SkillActor SkillCritic SkillDiscriminator "
        "SkillDynamics SkillEncoder SkillPolicy TerminationNetwork",
        "skill_prior": "fixed=FixedSkillPrior growing=GrowingSkillPrior learned=LearnedSkillPrior",
        "termination": "learned=LearnedTermination stall=StallTermination",
    },
    "torchrl_hmcts.envs": {
        "env": "atari_ram=AtariRAMEnv gridworld=GridworldMazeEnv labmaze=LabMazeEnv "
        "mujoco_batch=MujocoBatch "
        "settable_gym=SettableGymEnv stateless=StatelessSimulator waterworld=WaterworldMazeEnv",
    },
    "torchrl_hmcts.trainers": {
        "trainer": "a3c=A3CTrainer diayn=DIAYNTrainer hmcts=HMCTSTrainer",
        "hook": "skill_reward=SkillRewardHook",
    },
    "torchrl.data": {"action_spec": "Bounded Categorical OneHot"},
}


def _names(classes: str, group: str) -> dict[str, str]:
    """Classes by their names in a group."""
    found = {}
    for word in classes.split():
        name, _, component = word.rpartition("=")
        short = re.sub(f"{group}$", "", component, flags=re.IGNORECASE)
        found[name or re.sub("(?<=[a-z])(?=[A-Z])", "_", short).lower()] = component
    return found


COMPONENTS: Mapping[str, Mapping[str, str]] = {
    group: {name: f"{package}.{component}" for name, component in _names(names, group).items()}
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
def config_of(path: str, base: type = ComponentConfig) -> Any:
    """Make the config of a class from its signature."""
    component = named(path)
    hints = _hints(component)
    fields: list[Any] = [
        (name, hints.get(name, Any), _as_field(parameter.default))
        for name, parameter in keywords_of(component).items()
    ]
    fields += [("_component_", str, path), ("_target_", str, _TARGET)]
    made = dataclasses.make_dataclass(f"{component.__name__}Config", fields, bases=(base,))
    made.__module__ = __name__
    made.__doc__ = f"Keys of :class:`~{path}`."
    return made


def register_configs() -> None:
    """Put all configs into Hydra's store, but for classes whose package is not installed."""
    store = ConfigStore.instance()
    for group, names in COMPONENTS.items():
        for name, path in names.items():
            with contextlib.suppress(ModuleNotFoundError):
                node = config_of(path, _BASES.get(group, ComponentConfig))
                store.store(group=group, name=name, node=node, package=_PLACES.get(group))
    for name, experiment in ALL_EXPERIMENTS.items():
        store.store(group="experiment", name=name, node=experiment.config_class)


def _hints(component: type) -> dict[str, Any]:
    """The annotations that Hydra can check: plain types and None; others are left to the class."""
    checked: dict[str, Any] = {}
    for init in constructors(component):
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


def compose_parts(
    own: Mapping[str, Mapping[str, Any]], words: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Compose components with Hydra; return them with all their keywords."""
    config = {part: full(node) for part, node in own.items()}
    known = [*_flat(config), *_choices(config)]
    overrides = []
    for word in words:
        key, separator, name = word.partition("=")
        place, group = key.replace("/", "."), key.rpartition("/")[2]
        if not separator:
            raise ValueError(f"{word!r} is no key=value, e.g. planner/tree_policy=puct.")
        if "/" not in key and key not in config:
            overrides.append(word)
            continue
        parent, _, last = place.rpartition(".")
        where: Any = {"": config}.get(parent) or _at(config, parent)
        if group not in COMPONENTS or not isinstance(where, dict) or last not in where:
            raise ValueError(unknown_key(key, _choices(config)))
        classes = {path.rpartition(".")[2]: short for short, path in COMPONENTS[group].items()}
        name = classes.get(name, name)
        if name not in COMPONENTS[group]:
            raise ValueError(unknown_key(name, COMPONENTS[group], group))
        before, path = where[last] or {}, COMPONENTS[group][name]
        if before.get("_component_") != path:  # the same class keeps its keywords
            needed = [n for n, p in keywords_of(named(path)).items() if p.default is p.empty]
            where[last] = {n: before[n] for n in needed if n in before}
            known += [f"{place}.{keyword}" for keyword in keywords_of(named(path))]
            overrides.append(f"+{group}@{place}={name}")
    store = ConfigStore.instance()
    store.store(name="hmcts", node={"defaults": ["_self_"], **config})
    try:
        composed = _compose(overrides)
    except (HydraException, OmegaConfBaseException) as error:
        for key in (word.partition("=")[0] for word in words):
            if "/" not in key and key not in known:
                raise ValueError(unknown_key(key, known)) from None
        raise ValueError(" ".join(str(error).split()).partition(" full_key:")[0]) from None
    return {part: _clean(part, composed[part], top=True) for part in config}


def _compose(overrides: Sequence[str]) -> dict[str, Any]:
    begun = GlobalHydra.instance().is_initialized()
    with contextlib.nullcontext() if begun else initialize(version_base=None):
        config = compose("hmcts", list(overrides))
    found: Any = OmegaConf.to_container(config, resolve=True)
    return found


def full(node: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a component with the defaults of its class."""
    defaults: Any = OmegaConf.to_container(OmegaConf.structured(config_of(node["_component_"])))
    entries = {k: v for k, v in defaults.items() if k not in _INTERNAL and v != MISSING}
    for key, value in node.items():
        entries[key] = (
            full(value) if isinstance(value, Mapping) and "_component_" in value else value
        )
    return entries


def _clean(place: str, node: dict[str, Any], top: bool = False) -> dict[str, Any]:
    """The entries of a composed component, their types checked; nothing needed is missing."""
    node = {k: v for k, v in node.items() if k not in _INTERNAL}
    missing = [key for key, value in node.items() if value == MISSING]
    if missing and not top:
        raise ValueError(f"{place} needs {missing[0]}: give {place}.{missing[0]}=VALUE.")
    node = {k: v for k, v in node.items() if v != MISSING}
    plain = {k: v for k, v in node.items() if not isinstance(v, Mapping)}
    try:
        OmegaConf.merge(OmegaConf.structured(config_of(node["_component_"])), plain)
    except OmegaConfBaseException as error:
        key = getattr(error, "key", None) or getattr(error, "full_key", "")
        raise ValueError(f"{place}.{key}: {str(error).splitlines()[0]}.") from None
    for key, value in node.items():
        if isinstance(value, Mapping) and "_component_" in value:
            node[key] = _clean(f"{place}.{key}", dict(value))
    return node


def _at(config: Mapping[str, Any], place: str) -> Any:
    for name in place.split("."):
        config = config.get(name) or {}
    return config


def _flat(config: Mapping[str, Any], prefix: str = "") -> list[str]:
    """The places of all values in nested dicts."""
    found = []
    for key, value in config.items():
        if isinstance(value, Mapping):
            found += _flat(value, f"{prefix}{key}.")
        elif not key.startswith("_"):
            found.append(prefix + key)
    return found


def _choices(config: Mapping[str, Any]) -> list[str]:
    """The keys that choose a class."""
    chosen = [part for part in config if part in COMPONENTS]
    return chosen + [
        f"{p}/{key}" for p, node in config.items() for key in node if key in COMPONENTS
    ]


register_configs()
