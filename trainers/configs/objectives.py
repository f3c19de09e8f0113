"""Configs of what makes skills different, group ``objective``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from torchrl_hmcts.trainers.configs.base import ComponentConfig


@dataclass
class SkillDiscriminatorLossConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.SkillDiscriminatorLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> instantiate(SkillDiscriminatorLossConfig(_partial_=True))(
        ...     discriminator=SkillDiscriminator(2, num_skills=3)).out_keys
        ['loss_discriminator', 'discriminator_accuracy']
    """

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
    """Keys of :class:`~torchrl_hmcts.objectives.SkillDynamicsLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import SkillDynamics
        >>> instantiate(SkillDynamicsLossConfig(_partial_=True))(
        ...     dynamics=SkillDynamics(2, 2, num_skills=3)).in_keys
        ['skill', 'position', ('next', 'position')]
    """

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
    """Keys of :class:`~torchrl_hmcts.objectives.METRAEncoderLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import SkillEncoder
        >>> instantiate(METRAEncoderLossConfig(_partial_=True))(
        ...     encoder=SkillEncoder(2, num_skills=3)).out_keys
        ['loss_encoder', 'loss_dual', 'latent_distance', 'dual']
    """

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
    """Keys of :class:`~torchrl_hmcts.objectives.LSDEncoderLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import SkillEncoder, SpectralLinear
        >>> encoder = SkillEncoder(2, num_skills=3, linear=SpectralLinear)
        >>> instantiate(LSDEncoderLossConfig(_partial_=True))(encoder=encoder).out_keys
        ['loss_encoder', 'latent_distance']
    """

    encoder: Any = MISSING
    """Reads its in_keys and writes representation [*B, Z]; 1-Lipschitz, e.g."""
    num_skills: int | None = None
    """Number of skills Z."""
    prior: Any = None
    """Probabilities of the skills; null: uniform."""
    reduction: str = "mean"
    """"mean", "sum" or "none"."""
    _component_: str = "torchrl_hmcts.objectives.LSDEncoderLoss"
