"""Hierarchical Monte Carlo tree search over learned skills, as TorchRL components.

The parts are in :mod:`torchrl_hmcts.planners`, :mod:`torchrl_hmcts.transforms`,
:mod:`torchrl_hmcts.modules`, :mod:`torchrl_hmcts.objectives`, :mod:`torchrl_hmcts.envs`,
:mod:`torchrl_hmcts.trainers` and :mod:`torchrl_hmcts.testing`.
"""

__version__ = "0.1.0"

__all__ = ["__version__"]
