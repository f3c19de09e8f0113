"""Components built from plain dicts: a class by its path, keywords by name, parts within parts."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator, Mapping
from typing import Any

import torch


def build(_component_: str, **keywords: Any) -> Any:
    """Build a component from the entries of its config.

    Lists become tuples where the keyword is a (nested) key. Names become what they name where the
    default is a class or function, e.g. ``activation="torch.nn.Tanh"``. A dict with
    ``"_component_"`` becomes that component. A loss that calls its critic ``qvalue_network`` also
    takes it as ``critic_network``, as TorchRL's trainer configs pass it.
    """
    component = named(_component_)
    parameters = keywords_of(component)
    if "critic_network" not in parameters and "qvalue_network" in parameters:
        critic = keywords.pop("critic_network", None)
        if critic is not None:
            keywords["qvalue_network"] = critic
    return component(
        **{name: _typed(value, parameters.get(name)) for name, value in keywords.items()}
    )


def named(path: str) -> Any:
    """Return what a dotted path names."""
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


def constructors(component: type) -> Iterator[Any]:
    """Yield the constructor of a class, and where it takes ``**keywords`` those they are for."""
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


def keywords_of(component: type) -> dict[str, inspect.Parameter]:
    """Return the parameters of a constructor that have a name of their own."""
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    found: dict[str, inspect.Parameter] = {}
    for init in constructors(component):
        for name, parameter in inspect.signature(init).parameters.items():
            if name != "self" and parameter.kind not in variable:
                found.setdefault(name, parameter)
    return found


def merged(own: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a component with changes; another ``"_component_"`` replaces all."""
    if changes.get("_component_", own.get("_component_")) != own.get("_component_"):
        return dict(changes)
    out = dict(own)
    for name, value in changes.items():
        both = isinstance(value, Mapping) and isinstance(out.get(name), Mapping)
        out[name] = merged(out[name], value) if both else value
    return out


def differences(own: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes with which :func:`merged` makes the second of the first."""
    if own.get("_component_") != other.get("_component_"):
        return dict(other)
    out: dict[str, Any] = {}
    for name, value in other.items():
        before = own.get(name)
        if isinstance(value, Mapping) and isinstance(before, Mapping):
            value = differences(before, value)
            if value:
                out[name] = value
        elif value != before:
            out[name] = value
    return out


def _typed(value: Any, parameter: inspect.Parameter | None) -> Any:
    """A value of a config as the parameter takes it."""
    if type(value).__module__.startswith("omegaconf"):  # loaded with Hydra only
        from omegaconf import OmegaConf

        value = OmegaConf.to_container(value, resolve=True)
    if isinstance(value, Mapping) and "_component_" in value:
        return build(**value)
    if parameter is None:
        return value
    default = parameter.default
    is_name = default is not inspect.Parameter.empty and (
        callable(default) or isinstance(default, torch.dtype)
    )
    if isinstance(value, list) and "NestedKey" in str(parameter.annotation):
        if "Sequence[NestedKey]" in str(parameter.annotation):
            return [tuple(key) if isinstance(key, list) else key for key in value]
        return tuple(value)
    if isinstance(value, str) and is_name:
        return named(value)
    return value
