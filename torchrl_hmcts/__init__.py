"""Hierarchical Monte Carlo tree search over learned skills, as TorchRL components.

The parts are in its packages, e.g. :mod:`torchrl_hmcts.planners`; the names that a first script
needs are here as well.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_SHORTCUTS = {  # imported when asked for: the command line starts without torch
    "HMCTS": "trainers",
    "HierarchicalPolicy": "planners",
    "MCTSPlanner": "planners",
    "OptionTransform": "transforms",
    "RadiusNovelty": "planners",
    "SettableGymEnv": "envs",
    "WaterworldMazeEnv": "envs",
}
_PACKAGES = ("envs", "modules", "objectives", "planners", "testing", "trainers", "transforms")

__all__ = ["__version__", *_SHORTCUTS]


def __getattr__(name: str) -> Any:
    if name in _PACKAGES:
        return importlib.import_module(f"{__name__}.{name}")
    if name in _SHORTCUTS:
        return getattr(importlib.import_module(f"{__name__}.{_SHORTCUTS[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, *_PACKAGES]
