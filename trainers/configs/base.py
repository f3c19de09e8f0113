"""What all configs share: how a component is built from one, and how one is written as yaml."""

from __future__ import annotations

import importlib
import inspect
import textwrap
from collections.abc import Callable
from dataclasses import MISSING as NO_DEFAULT
from dataclasses import dataclass, fields
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from torchrl.trainers.algorithms.configs.common import ConfigBase
from torchrl.trainers.algorithms.configs.envs import EnvConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig
from torchrl.trainers.algorithms.configs.transforms import TransformConfig

from torchrl_hmcts.trainers.experiments.registry import field_docs

_TARGET = "torchrl_hmcts.trainers.configs.build"


@dataclass
class ComponentConfig(ConfigBase):
    """A config from which ``hydra.utils.instantiate`` builds a component.

    ``_component_`` names its class, whose keywords are the other fields, with the same defaults.
    With ``_partial_=True`` what is built is a function of the keywords that are still missing:
    objects such as envs and networks are better handed over so than through Hydra, which copies.

    Example:
        >>> from hydra.utils import instantiate
        >>> from dataclasses import dataclass
        >>> @dataclass
        ... class UCTConfig(ComponentConfig):
        ...     c: float = 1.0
        ...     _component_: str = "torchrl_hmcts.planners.UCT"
        >>> instantiate(UCTConfig(c=0.5))
        UCT(c=0.5)
    """

    _target_: str = _TARGET
    _partial_: bool = False

    def __post_init__(self) -> None:
        """Nothing is checked here: the component does when it is built."""


@dataclass
class LossComponentConfig(LossConfig):
    """A :class:`ComponentConfig` that TorchRL's configs take as a loss.

    Example:
        >>> from torchrl_hmcts.trainers.configs import SkillPriorLossConfig
        >>> isinstance(SkillPriorLossConfig(), LossComponentConfig)
        True
    """

    _target_: str = _TARGET


@dataclass
class TransformComponentConfig(TransformConfig):
    """A :class:`ComponentConfig` that TorchRL's configs take as a transform.

    Example:
        >>> from torchrl_hmcts.trainers.configs import SkillTransformConfig
        >>> isinstance(SkillTransformConfig(num_skills=4), TransformComponentConfig)
        True
    """

    _target_: str = _TARGET
    _partial_: bool = False


@dataclass
class EnvComponentConfig(EnvConfig):
    """A :class:`ComponentConfig` that TorchRL's configs take as an env.

    Example:
        >>> from torchrl_hmcts.trainers.configs import WaterworldMazeEnvConfig
        >>> isinstance(WaterworldMazeEnvConfig(), EnvComponentConfig)
        True
    """

    _target_: str = _TARGET


def build(_component_: str, **keywords: Any) -> Any:
    """Build a component from what stands in its config.

    Lists become tuples where the keyword is a (nested) key, and names become what they name where
    the default is a class or function, e.g. ``activation="torch.nn.Tanh"``.

    Args:
        _component_: its class, e.g. ``"torchrl_hmcts.planners.UCT"``.
        **keywords: of the class.

    Returns:
        The component.

    Example:
        >>> build("torchrl_hmcts.planners.UCT", c=0.5)
        UCT(c=0.5)
    """
    component = named(_component_)
    parameters = inspect.signature(component.__init__).parameters
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


def to_yaml(config_class: Callable[[], Any]) -> str:
    """Write a config as yaml: every key with its default, and a sentence above it.

    Args:
        config_class: a dataclass of this package, or of an experiment.

    Example:
        >>> from torchrl_hmcts.trainers.configs import UCTConfig
        >>> print(to_yaml(UCTConfig))
        # Exploration constant, in units of the return.
        c: 1.0
        _target_: torchrl_hmcts.trainers.configs.build
        _component_: torchrl_hmcts.planners.UCT
        _partial_: false
        <BLANKLINE>
    """
    meanings = field_docs(config_class)  # type: ignore[arg-type]
    internal = ("_target_", "_component_", "_partial_")
    values = {f.name: _default(f) for f in fields(config_class)}  # type: ignore[arg-type]
    names = [name for name in values if name not in internal]
    parts = []
    for name in [*names, *(name for name in internal if name in values)]:
        if name in meanings:
            parts.append(
                textwrap.fill(meanings[name], 98, initial_indent="# ", subsequent_indent="# ")
            )
        parts.append(OmegaConf.to_yaml({name: values[name]}).rstrip())
    return "\n".join(parts) + "\n"


def _default(field: Any) -> Any:
    return field.default if field.default_factory is NO_DEFAULT else field.default_factory()


def _typed(value: Any, parameter: inspect.Parameter | None) -> Any:
    if isinstance(value, DictConfig | ListConfig):
        value = OmegaConf.to_container(value, resolve=True)
    if parameter is None:
        return value
    required = parameter.default is inspect.Parameter.empty  # itself a class
    kind = str(parameter.annotation)
    if isinstance(value, list) and "NestedKey" in kind:
        if "Sequence[NestedKey]" in kind:
            return [tuple(key) if isinstance(key, list) else key for key in value]
        return tuple(value)
    if isinstance(value, str) and not required and callable(parameter.default):
        return named(value)
    return value
