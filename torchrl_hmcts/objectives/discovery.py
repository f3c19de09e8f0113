"""Published objectives of skill discovery: DIAYN's, METRA's, LSD's and DADS's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F
from torch.nn.utils.parametrize import is_parametrized

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.modules.objective_networks import SpectralLinear
from torchrl_hmcts.modules.skill_spec import draw_vectors, needs_number
from torchrl_hmcts.objectives.loss import output_of, run_module
from torchrl_hmcts.objectives.skill_objective import SkillObjective


class SkillDiscriminatorLoss(SkillObjective):
    r"""Skills that can be told apart: a discriminator guesses the skill from the state it led to.

    .. math::

        L(\phi) = -\log q_\phi(z \mid s'), \qquad r = \log q_\phi(z \mid s') - \log p(z)

    Skills that the prior switches off are never guessed: their logits count as ``-inf``.

    Args:
        discriminator (TensorDictModuleBase): reads its ``in_keys`` from ``"next"`` and writes
            ``skill_logits`` ``[*B, Z]``, e.g. a
            :class:`~torchrl_hmcts.modules.SkillDiscriminator`.
        num_skills, prior, reduction: as in :class:`SkillObjective`.

    Returns:
        TensorDict with ``loss_discriminator`` and the detached ``discriminator_accuracy`` (fraction
        of transitions whose skill has the highest logit).

    Keys (``set_keys``): those of :class:`SkillObjective` and ``skill_logits``.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070, algorithm 1.

    Examples:
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss
        >>> SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills=4)).in_keys
        ['skill', ('next', 'displacement')]
    """

    @dataclass
    class _AcceptedKeys(SkillObjective._AcceptedKeys):
        skill_logits: NestedKey = "skill_logits"

    out_keys = ["loss_discriminator", "discriminator_accuracy"]
    root_features = ()

    discriminator: TensorDictModuleBase
    discriminator_params: TensorDictParams
    target_discriminator_params: TensorDictParams

    def __init__(self, discriminator: TensorDictModuleBase, **settings: Any) -> None:
        super().__init__(discriminator=discriminator, **settings)
        needs_number("SkillDiscriminatorLoss", self.skill_spec)

    @property
    def next_features(self) -> list[NestedKey]:  # type: ignore[override]
        """The entries that the discriminator reads of the state after a transition."""
        return self.discriminator.in_keys

    def skill_logits(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the logits ``[*B, Z]`` of q(z | s') for transitions ``[*B]``."""
        module, params = self.discriminator, self.discriminator_params
        logits = output_of(module, params, tensordict.get("next"), self.tensor_keys.skill_logits)
        off = self.inactive(logits.device)
        return logits if off is None else logits.masked_fill(off, -torch.inf)

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        logits, skill = self.skill_logits(tensordict), self.skill(tensordict)
        loss = F.cross_entropy(logits.flatten(0, -2), skill.flatten(), reduction="none")
        loss = self._of_active(loss.view(skill.shape), skill)
        hit = (logits.detach().argmax(-1) == skill).to(logits.dtype)
        return {
            "loss_discriminator": self._reduce(loss, tensordict),
            "discriminator_accuracy": self._average(hit),
        }

    @torch.no_grad()
    def reward(self, tensordict: TensorDictBase) -> Tensor:
        log_q = self.skill_logits(tensordict).log_softmax(-1)
        skill = self.skill(tensordict).unsqueeze(-1)
        return self._of_active(log_q.gather(-1, skill) - self.log_prior(log_q)[skill], skill)


class EncoderObjective(SkillObjective):
    """The common part of LSD and METRA: an encoder, and travel along a skill's vector as reward."""

    @dataclass
    class _AcceptedKeys(SkillObjective._AcceptedKeys):
        representation: NestedKey = "representation"

    encoder: TensorDictModuleBase
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams

    def __init__(self, encoder: TensorDictModuleBase, **settings: Any) -> None:
        super().__init__(encoder=encoder, **settings)

    @property
    def root_features(self) -> list[NestedKey]:  # type: ignore[override]
        """The entries that the encoder reads of the states before and after a transition."""
        return self.encoder.in_keys

    next_features = root_features  # type: ignore[assignment]

    def skill_vectors(self) -> Tensor:
        r"""Returns the zero-centred vector of each skill under the prior of now, ``[Z, Z]``.

        .. math:: \bar e_z = \frac{e_z - p}{1 - \sum_i p_i^2}

        with :math:`e_z` the one-hot skill and :math:`p` the prior. For a uniform prior over n
        skills it is 1 for the skill and -1 / (n - 1) for the others, as in the papers.
        """
        p = self.prior.probs().detach()
        spread = 1.0 - p.square().sum()
        # A single skill has nothing to differ from: its vector, and so its reward, is zero.
        return (torch.eye(len(p)).to(p) - p) / spread.clamp_min(1e-6)

    def _step(self, tensordict: TensorDictBase) -> Tensor:
        """Returns phi(s') - phi(s), ``[*B, Z]``, for transitions ``[*B]``."""
        after = tensordict.get("next")
        both = {k: torch.stack((tensordict.get(k), after.get(k))) for k in self.encoder.in_keys}
        both = TensorDict(both, batch_size=(2, *tensordict.batch_size))
        key = self.tensor_keys.representation
        here, there = output_of(self.encoder, self.encoder_params, both, key).unbind(0)
        return there - here

    def _travel(self, step: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Returns the part of steps ``[*B, Z]`` that is along the vector of the skill, ``[*B]``."""
        skill = self.skill(tensordict)
        if self.num_skills is None:
            return (step * skill).sum(-1)
        return self._of_active((step * self.skill_vectors().to(step)[skill]).sum(-1), skill)

    @torch.no_grad()
    def reward(self, tensordict: TensorDictBase) -> Tensor:
        return self._travel(self._step(tensordict), tensordict).unsqueeze(-1)


class METRAEncoderLoss(EncoderObjective):
    r"""METRA: skills that travel far, in a latent space where one step has at most length 1.

    .. math::

        L(\phi) &= -\bigl[(\phi(s') - \phi(s))^\top \bar e_z + \lambda \,
        \min(\epsilon, 1 - \|\phi(s') - \phi(s)\|^2)\bigr] \\
        L(\lambda) &= \log \lambda \cdot \min(\epsilon, 1 - \|\phi(s') - \phi(s)\|^2), \qquad
        r = (\phi(s') - \phi(s))^\top \bar e_z

    with :math:`\bar e_z` the zero-centred one-hot vector of the skill (:meth:`skill_vectors`), or
    the skill itself if it is a vector, as the authors' on the :class:`UnitSphere` are. Distances
    are thus numbers of steps. :math:`\lambda` is held fixed in the first loss and the encoder in
    the second; :math:`\log \lambda` is the parameter.

    Args:
        encoder (TensorDictModuleBase): reads its ``in_keys`` and writes ``representation``
            ``[*B, Z]``, e.g. a :class:`~torchrl_hmcts.modules.SkillEncoder`.
        num_skills, prior, reduction: as in :class:`SkillObjective`.
        dual_init (float): :math:`\lambda` at the start. Default ``30.0``, as the authors'.
        slack (float): :math:`\epsilon`, by how much the constraint may be over-fulfilled before it
            stops to count. Default ``1e-3``, as the authors'.

    Returns:
        TensorDict with ``loss_encoder``, ``loss_dual`` and the detached ``latent_distance`` (the
        mean of :math:`\|\phi(s') - \phi(s)\|`) and ``dual`` (:math:`\lambda`).

    Raises:
        ValueError: if ``dual_init`` is not positive or ``slack`` is negative; see also
            :class:`SkillObjective`.

    Keys (``set_keys``): those of :class:`SkillObjective` and ``representation``.

    Reference:
        Park, Rybkin, Levine, "METRA: Scalable Unsupervised RL with Metric-Aware Abstraction", 2023,
        arXiv 2310.08887, algorithm 1. The authors' code takes the mean of the squares over
        dimensions where the paper, and this loss, take the sum.

    Examples:
        >>> from torchrl_hmcts.modules import SkillEncoder
        >>> from torchrl_hmcts.objectives import METRAEncoderLoss
        >>> METRAEncoderLoss(SkillEncoder(2, num_skills=3)).skill_vectors()[0]
        tensor([ 1.0000, -0.5000, -0.5000])
    """

    out_keys = ["loss_encoder", "loss_dual", "latent_distance", "dual"]

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        *,
        dual_init: float = 30.0,
        slack: float = 1e-3,
        **settings: Any,
    ) -> None:
        super().__init__(encoder, **settings)
        dual = real_number("METRAEncoderLoss", "dual_init", dual_init, above=0.0)
        self.slack = real_number("METRAEncoderLoss", "slack", slack, least=0.0)
        self.log_dual = torch.nn.Parameter(torch.tensor(math.log(dual)))

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        step = self._step(tensordict)
        square = step.square().sum(-1)  # [*B]
        room = (1.0 - square).clamp_max(self.slack)
        dual = self.log_dual.detach().exp()
        loss = -self._travel(step, tensordict) - dual * room
        return {
            "loss_encoder": self._reduce(loss, tensordict),
            "loss_dual": self._reduce(self.log_dual * room.detach(), tensordict),
            "latent_distance": self._average(square.detach().sqrt()),
            "dual": self._average(dual.expand(square.shape)),
        }


class LSDEncoderLoss(EncoderObjective):
    r"""LSD: skills that travel far, measured by an encoder that may not stretch distances.

    .. math::

        L(\phi) = -r, \qquad r = (\phi(s') - \phi(s))^\top \bar e_z, \qquad
        \|\phi(x) - \phi(y)\| \le \|x - y\|

    with :math:`\bar e_z` as in :class:`METRAEncoderLoss`. The reward is in the units of what the
    encoder reads; scale it by the ``intrinsic_coeff`` of
    :class:`~torchrl_hmcts.transforms.SkillReward`.

    Args:
        encoder (TensorDictModuleBase): reads its ``in_keys`` and writes ``representation``
            ``[*B, Z]``; 1-Lipschitz, e.g. ``SkillEncoder(..., linear=SpectralLinear)``.
        num_skills, prior, reduction: as in :class:`SkillObjective`.

    Returns:
        TensorDict with ``loss_encoder`` and the detached ``latent_distance``, the mean of
        :math:`\|\phi(s') - \phi(s)\|`.

    Raises:
        ValueError: if a linear layer of the encoder is not normalised.

    Keys (``set_keys``): those of :class:`METRAEncoderLoss`.

    Reference:
        Park et al., "Lipschitz-constrained Unsupervised Skill Discovery", 2022, arXiv 2202.00914.

    Examples:
        >>> from torchrl_hmcts.modules import SkillEncoder, SpectralLinear
        >>> from torchrl_hmcts.objectives import LSDEncoderLoss
        >>> LSDEncoderLoss(SkillEncoder(2, num_skills=4, linear=SpectralLinear)).in_keys
        ['skill', 'position', ('next', 'position')]
    """

    out_keys = ["loss_encoder", "latent_distance"]

    def __init__(self, encoder: TensorDictModuleBase, **settings: Any) -> None:
        for name, layer in encoder.named_modules():
            plain = isinstance(layer, torch.nn.Linear) and not isinstance(layer, SpectralLinear)
            if plain and not is_parametrized(layer, "weight"):
                raise ValueError(
                    "LSDEncoderLoss needs an encoder that cannot stretch distances, but its layer "
                    f"{name!r} is a plain Linear, whose weights would grow without bound. Pass "
                    "SkillEncoder(..., linear=SpectralLinear)."
                )
        super().__init__(encoder, **settings)

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        step = self._step(tensordict)
        return {
            "loss_encoder": self._reduce(-self._travel(step, tensordict), tensordict),
            "latent_distance": self._average(step.norm(dim=-1)),
        }


class SkillDynamicsLoss(SkillObjective):
    r"""DADS: skills whose outcome can be predicted, and differs from that of the other skills.

    .. math::

        L(\phi) = -\log q_\phi(s' \mid s, z), \qquad
        r = \log q_\phi(s' \mid s, z) - \log \sum_i p(z_i)\, q_\phi(s' \mid s, z_i)

    with the skill dynamics :math:`q` a Gaussian of the change :math:`s' - s`. The sum is over all
    skills, so the reward is at most :math:`-\log p(z)`. Of vectors ``prior_samples`` are drawn, as
    in the paper, and averaged together with the skill itself, as in the authors' code.

    Args:
        dynamics (TensorDictModuleBase): reads its ``in_keys`` of a state and writes ``skill_loc``
            and ``skill_scale``, both ``[*B, Z, D]``: mean and standard deviation of the change of
            its attribute ``target_key`` under each skill; e.g. a
            :class:`~torchrl_hmcts.modules.SkillDynamics`.
        num_skills, prior, reduction: as in :class:`SkillObjective`.
        prior_samples (int): vectors drawn at each call. Default 64; the authors take up to 500.

    Returns:
        TensorDict with ``loss_dynamics`` (nats) and the detached ``dynamics_accuracy`` (fraction
        of transitions for which the skill is the most probable one given the change).

    Raises:
        AttributeError: if the dynamics have no ``target_key``.

    Keys (``set_keys``): those of :class:`SkillObjective`, ``skill_loc`` and ``skill_scale``.

    Reference:
        Sharma et al., "Dynamics-Aware Unsupervised Discovery of Skills", 2019, arXiv 1907.01657,
        algorithm 1.

    Examples:
        >>> from torchrl_hmcts.modules import SkillDynamics
        >>> from torchrl_hmcts.objectives import SkillDynamicsLoss
        >>> SkillDynamicsLoss(SkillDynamics(2, 2, num_skills=4)).in_keys
        ['skill', 'position', ('next', 'position')]
    """

    @dataclass
    class _AcceptedKeys(SkillObjective._AcceptedKeys):
        skill_loc: NestedKey = "skill_loc"
        skill_scale: NestedKey = "skill_scale"

    out_keys = ["loss_dynamics", "dynamics_accuracy"]

    dynamics: TensorDictModuleBase
    dynamics_params: TensorDictParams
    target_dynamics_params: TensorDictParams

    def __init__(
        self, dynamics: TensorDictModuleBase, *, prior_samples: int = 64, **settings: Any
    ) -> None:
        super().__init__(dynamics=dynamics, **settings)
        self.prior_samples = whole_number(
            "SkillDynamicsLoss", "prior_samples", prior_samples, least=1
        )
        self.next_features = [dynamics.target_key]
        read = list(dynamics.in_keys)
        if self.num_skills is None:
            self._skill_key = read.pop()
        self.root_features = list(dict.fromkeys([*read, *self.next_features]))

    def log_densities(self, tensordict: TensorDictBase) -> Tensor:
        """Returns log q(s' | s, z) for every skill z, ``[*B, Z]``, for transitions ``[*B]``.

        Of vectors for the transition's own, which comes first, and for the drawn ones.
        """
        if self.num_skills is not None:
            return self._log_density(tensordict)
        own, batch = self.skill(tensordict), tensordict.batch_size
        drawn = draw_vectors(self.skill_spec, (self.prior_samples,)).to(own)
        drawn = drawn.view(-1, *[1] * len(batch), drawn.shape[-1]).expand(-1, *batch, -1)
        others = tensordict.expand(self.prior_samples, *batch).copy().set(self._skill_key, drawn)
        with torch.no_grad():
            density = self._log_density(others).movedim(0, -1)
        own_density = self._log_density(tensordict.copy().set(self._skill_key, own))
        return torch.cat((own_density.unsqueeze(-1), density), -1)

    def _log_density(self, tensordict: TensorDictBase) -> Tensor:
        """Returns log q of what the dynamics write, ``[*B, Z]``, or ``[*B]`` of vectors."""
        root = run_module(self.dynamics, self.dynamics_params, tensordict)
        loc = root.get(self.tensor_keys.skill_loc)
        scale = root.get(self.tensor_keys.skill_scale)
        key = self.dynamics.target_key
        change = (tensordict.get("next").get(key) - tensordict.get(key)).to(loc.dtype)
        if change.shape[-1] != loc.shape[-1]:
            raise ValueError(
                f"SkillDynamicsLoss has dynamics of {loc.shape[-1]} numbers, but {key!r} has "
                f"{change.shape[-1]}. Build them with target_features={change.shape[-1]}."
            )
        if self.num_skills is not None:
            change = change.unsqueeze(-2)
        error = (change - loc) / scale
        constant = 0.5 * math.log(2.0 * math.pi)
        return -(0.5 * error.square() + scale.log() + constant).sum(-1)

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        density = self.log_densities(tensordict)
        if self.num_skills is None:
            likeliest = density[..., 0] >= density[..., 1:].amax(-1)
            return {
                "loss_dynamics": self._reduce(-density[..., 0], tensordict),
                "dynamics_accuracy": self._average(likeliest.to(density.dtype)),
            }
        skill = self.skill(tensordict)
        loss = -density.gather(-1, skill.unsqueeze(-1)).squeeze(-1)
        guess = (density.detach() + self.log_prior(density)).argmax(-1)
        return {
            "loss_dynamics": self._reduce(self._of_active(loss, skill), tensordict),
            "dynamics_accuracy": self._average((guess == skill).to(density.dtype)),
        }

    @torch.no_grad()
    def reward(self, tensordict: TensorDictBase) -> Tensor:
        density = self.log_densities(tensordict)
        if self.num_skills is None:
            evidence = density.logsumexp(-1, keepdim=True) - math.log(density.shape[-1])
            return density[..., :1] - evidence
        skill = self.skill(tensordict).unsqueeze(-1)
        evidence = (density + self.log_prior(density)).logsumexp(-1, keepdim=True)
        return self._of_active(density.gather(-1, skill) - evidence, skill)
