"""Configs of what makes skills different, group ``objective``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from torchrl_hmcts.trainers.configs.base import ComponentConfig


@dataclass
class SkillDiscriminatorLossConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.SkillDiscriminatorLoss`."""

    discriminator: Any = MISSING
    """Reads its in_keys and writes skill_logits [*B, Z], e.g. a SkillDiscriminator."""
    num_skills: int | None = None
    """Number of skills Z."""
    prior: Any = None
    """Probabilities of the skills; null: uniform."""
    reduction: str = "mean"
    """"mean", "sum" or "none"."""
    _component_: str = "torchrl_hmcts.objectives.SkillDiscriminatorLoss"


@dataclass
class SkillDynamicsLossConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.SkillDynamicsLoss`."""

    dynamics: Any = MISSING
    """Reads its in_keys of a state and writes skill_loc and skill_scale, both [*B, Z, D]: mean and
    standard deviation of the change of its attribute target_key under each skill; e.g. a
    SkillDynamics."""
    num_skills: int | None = None
    """Number of skills Z."""
    prior: Any = None
    """Probabilities of the skills; null: uniform."""
    reduction: str = "mean"
    """"mean", "sum" or "none"."""
    _component_: str = "torchrl_hmcts.objectives.SkillDynamicsLoss"


@dataclass
class METRAEncoderLossConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.METRAEncoderLoss`."""

    encoder: Any = MISSING
    """Reads its in_keys and writes representation [*B, Z], e.g. a SkillEncoder."""
    num_skills: int | None = None
    """Number of skills Z."""
    prior: Any = None
    """Probabilities of the skills; null: uniform."""
    dual_init: float = 30.0
    """Dual variable at the start."""
    slack: float = 0.001
    """By how much the constraint may be over-fulfilled before it stops to count."""
    reduction: str = "mean"
    """"mean", "sum" or "none"."""
    _component_: str = "torchrl_hmcts.objectives.METRAEncoderLoss"


@dataclass
class LSDEncoderLossConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.LSDEncoderLoss`."""

    encoder: Any = MISSING
    """Reads its in_keys and writes representation [*B, Z]; 1-Lipschitz, e.g."""
    num_skills: int | None = None
    """Number of skills Z."""
    prior: Any = None
    """Probabilities of the skills; null: uniform."""
    reduction: str = "mean"
    """"mean", "sum" or "none"."""
    _component_: str = "torchrl_hmcts.objectives.LSDEncoderLoss"
