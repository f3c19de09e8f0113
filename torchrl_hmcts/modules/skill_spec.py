"""Specs of skills: numbers of a list, or vectors.

Letters: ``*B`` any batch shape, ``Z`` skills, ``D`` numbers of a skill's vector.
"""

from __future__ import annotations

from abc import ABCMeta
from collections.abc import Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec, Unbounded

from torchrl_hmcts.checks import whole_number

Skills: TypeAlias = int | TensorSpec

_KINDS = "UnitSphere(D), Bounded(low, high, shape=(D,)) or Unbounded(shape=(D,))"


class _KeepsItsClass(type(Unbounded)):  # type: ignore[misc]
    """TorchRL's own makes every unbounded spec one of its two classes."""

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        return ABCMeta.__call__(cls, *args, **kwargs)


class UnitSphere(Unbounded, metaclass=_KeepsItsClass):
    r"""Vectors of length 1, drawn evenly from all directions: the skills of METRA.

    .. math:: z = \frac{x}{\|x\|}, \qquad x \sim \mathcal{N}(0, I)

    A TorchRL spec, to be passed wherever a number of skills can be, as TorchRL's own:
    ``Unbounded(shape=(D,))`` draws from :math:`\mathcal{N}(0, I)`, ``Bounded(low, high,
    shape=(D,))`` evenly from a box.

    Args:
        shape (int or torch.Size): D, or ``[*B, D]``.
        device (torch.device, optional): Default: torch's.
        dtype (torch.dtype, optional): of floats. Default: torch's.

    Reference:
        Park, Rybkin, Levine, "METRA: Scalable Unsupervised RL with Metric-Aware Abstraction", 2023,
        arXiv 2310.08887, appendix.

    Examples:
        >>> from torchrl_hmcts.modules import UnitSphere
        >>> sphere = UnitSphere(3)
        >>> sphere.rand((5,)).norm(dim=-1).allclose(torch.ones(5))
        True
        >>> sphere.is_in(torch.ones(3))
        False
    """

    def rand(self, shape: torch.Size | None = None) -> Tensor:
        """Returns directions ``[*shape, *B, D]``."""
        return F.normalize(super().rand(shape), dim=-1)

    def is_in(self, val: Tensor) -> bool:
        """Returns whether all vectors have length 1, up to rounding."""
        return super().is_in(val) and bool(((val.norm(dim=-1) - 1.0).abs() < 1e-3).all())

    def project(self, val: Tensor) -> Tensor:
        """Returns vectors scaled to length 1."""
        return F.normalize(val, dim=-1)

    def to(self, dest: Any) -> UnitSphere:
        """Returns the spec of another device or type."""
        other = super().to(dest)
        return UnitSphere(self.shape, device=other.device, dtype=other.dtype)


def as_skill_spec(owner: str, skills: Skills, name: str = "num_skills") -> TensorSpec:
    """Returns the spec of one skill: of a number of skills a ``Categorical``, of vectors its own.

    Raises:
        ValueError: if a spec is neither.
    """
    if not isinstance(skills, TensorSpec):
        return Categorical(whole_number(owner, name, skills, least=1))
    if type(skills) in (Categorical, OneHot):
        return Categorical(int(skills.space.n))
    vectors = isinstance(skills, (Bounded, Unbounded)) and skills.dtype.is_floating_point
    if not vectors or skills.ndim != 1 or not skills.shape[0]:
        raise ValueError(
            f"{owner} needs a number of skills for {name}, or the spec of one skill vector: "
            f"{_KINDS}; got {type(skills).__name__} of {skills.dtype}, shape {list(skills.shape)}."
        )
    if isinstance(skills, Bounded):
        ends = torch.stack((skills.space.low, skills.space.high))
        if not ends.isfinite().all():
            raise ValueError(
                f"{owner} draws skills evenly between the bounds of their spec, which must be "
                f"finite; got {ends.tolist()}."
            )
    return skills


def number_of(spec: TensorSpec) -> int | None:
    """Returns the number of skills; None for vectors."""
    return int(spec.space.n) if isinstance(spec, Categorical) else None


def needs_number(owner: str, skills: Skills) -> int:
    """Returns the number of skills; refuses vectors, which have no number."""
    spec = as_skill_spec(owner, skills)
    number = number_of(spec)
    if number is None:
        raise ValueError(
            f"{owner} needs numbered skills; got {described(spec)}. For vectors use "
            "METRAEncoderLoss, LSDEncoderLoss or SkillDynamicsLoss."
        )
    return number


def same_skills(one: TensorSpec, other: TensorSpec) -> bool:
    """Returns whether two specs of one skill are of as many skills, or of vectors as long."""
    return number_of(one) == number_of(other) and one.shape == other.shape


def described(spec: TensorSpec) -> str:
    """Returns what a spec's skills are, for an error."""
    number = number_of(spec)
    return f"vectors of {spec.shape[-1]} numbers" if number is None else f"{number} skills"


def require_known(owner: str, reader: object, known: TensorSpec, drawn: TensorSpec) -> None:
    """Refuses an env that draws skills, by the spec of its batch, which a reader does not know."""
    number, most = number_of(drawn), number_of(known)
    if number is None or most is None:
        fits = number == most and drawn.shape[-1:] == known.shape
    else:
        fits = number <= most
    if not fits:
        raise ValueError(
            f"{owner}: the env draws {described(drawn)}, but {type(reader).__name__} knows "
            f"{described(known)}. Give both the same: "
            + ("one spec." if most is None else f"SkillTransform({most}).")
        )


def no_prior(owner: str, spec: TensorSpec) -> str:
    """Returns the error of a prior for vectors."""
    return (
        f"{owner} takes a prior over a number of skills; these are {described(spec)}, drawn as "
        f"their spec says. Leave prior out, or give another spec: {_KINDS}."
    )


def draw_vectors(
    spec: TensorSpec, shape: Sequence[int], generator: torch.Generator | None = None
) -> Tensor:
    """Returns vectors of a spec of one skill, ``[*shape, D]``, on the CPU."""
    shape = (*shape, spec.shape[-1])
    if isinstance(spec, Bounded):
        low, high = spec.space.low.cpu(), spec.space.high.cpu()
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=spec.dtype)
    x = torch.randn(shape, generator=generator, dtype=spec.dtype)
    return F.normalize(x, dim=-1) if isinstance(spec, UnitSphere) else x


def spread_skills(spec: TensorSpec, number: int, *, seed: int = 0) -> Tensor:
    """Chooses a few skills that represent all vectors of a spec, as options to plan with.

    Vectors are drawn, those that are farthest from each other are taken first, and each is then
    moved to the mean of what is nearest to it, until all stay (k-means). On a sphere the mean is
    scaled to length 1. Pass them to ``OptionTransform(worker, Z, ..., skills=...)``.

    Args:
        spec (TensorSpec): of one skill ``[D]``, e.g. :class:`UnitSphere`.
        number (int): of vectors, Z.
        seed (int): of the draws. Default 0.

    Returns:
        Tensor: ``[Z, D]``.

    Raises:
        ValueError: if the spec is none of vectors, or the number is not positive.

    Reference:
        Gonzalez, "Clustering to minimize the maximum intercluster distance", 1985; Lloyd, "Least
        squares quantization in PCM", 1982.

    Examples:
        >>> from torchrl_hmcts.modules import UnitSphere, spread_skills
        >>> directions = spread_skills(UnitSphere(2), 4)  # about a right angle apart
        >>> (directions @ directions.T).sub(torch.eye(4)).max().item() < 0.1
        True
    """
    spec = as_skill_spec("spread_skills", spec, "spec")
    number = whole_number("spread_skills", "number", number, least=1)
    if isinstance(spec, Categorical):
        raise ValueError(
            f"spread_skills chooses among vectors; got a spec of {described(spec)}, which are "
            f"options already. Pass {_KINDS}."
        )
    generator = torch.Generator().manual_seed(seed)
    drawn = draw_vectors(spec, (max(4096, 256 * number),), generator)
    chosen = drawn[:1]
    distance = torch.cdist(drawn, chosen)[:, 0]
    for _ in range(number - 1):
        chosen = torch.cat((chosen, drawn[distance.argmax()][None]))
        distance = torch.minimum(distance, torch.cdist(drawn, chosen[-1:])[:, 0])
    for _ in range(100):
        nearest = torch.cdist(drawn, chosen).argmin(-1)
        count = torch.bincount(nearest, minlength=number).clamp_min(1).unsqueeze(-1)
        moved = torch.zeros_like(chosen).index_add_(0, nearest, drawn) / count
        moved = F.normalize(moved, dim=-1) if isinstance(spec, UnitSphere) else moved
        if torch.allclose(moved, chosen, atol=1e-6):
            break
        chosen = moved
    return chosen
