"""The skill-conditioned actor for continuous actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.modules import ProbabilisticActor, TanhNormal

from torchrl_hmcts.modules.skill_mlp import SkillMLP, entries, key_list


class GaussianSkillActor(ProbabilisticActor):
    r"""A continuous policy pi(a | s, z): a squashed Gaussian whose parameters come from the skill.

    .. math::

        a = \tfrac{h - l}{2} \tanh(u) + \tfrac{h + l}{2}, \qquad
        u \sim \mathcal{N}(\mu, \sigma^2), \qquad (\mu, \sigma) = \mathrm{SkillMLP}(s, z)

    with :math:`l, h` the bounds of the action. It is the actor TorchRL's ``SACLoss`` wants: a
    ``ProbabilisticActor`` with ``NormalParamExtractor`` and ``TanhNormal``. Inside options use the
    lean :class:`SkillPolicy` over the same parameters.

    Args:
        in_features (int): summed sizes of the entries ``in_keys``.
        action_spec (TensorSpec): the env's action spec, a ``Bounded`` with the last dimension
            ``D``; leading (batch) dimensions must have the same bounds.
        num_skills (int): number of skills.
        in_keys (sequence of NestedKey): observation entries ``[*B, f_i]``, concatenated in order.
        skill_key (NestedKey): entry of the skill, int64 ``[*B]``. Default ``"skill"``.
        action_key (NestedKey): entry the action is written to, ``[*B, D]``. Default ``"action"``.
        hidden (sequence of int): widths of the shared layers. Default ``(64, 64)``.
        activation (callable): builds the activations. Default ``torch.nn.ReLU``.
        network (callable): builds the network, with the signature of :class:`SkillMLP`. Default
            :class:`SkillMLP`; e.g. :class:`ConcatSkillMLP` for a skill that is concatenated.

    Raises:
        ValueError: if the action spec is not a ``Bounded`` of floats with finite bounds.

    Reference:
        Haarnoja et al., "Soft Actor-Critic", 2018, arXiv 1801.01290, appendix C (squashing);
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_hmcts.modules import GaussianSkillActor, SkillPolicy
        >>> spec = Bounded(-1.0, 1.0, shape=(2,))
        >>> actor = GaussianSkillActor(3, spec, num_skills=4, in_keys=["velocity"])
        >>> td = TensorDict(velocity=torch.randn(5, 3), skill=torch.zeros(5, dtype=torch.int64),
        ...                 batch_size=[5])
        >>> actor(td)["action"].shape
        torch.Size([5, 2])
        >>> SkillPolicy(actor, deterministic=True)(td)["action"].shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        in_features: int,
        action_spec: TensorSpec,
        num_skills: int,
        *,
        in_keys: Sequence[NestedKey],
        skill_key: NestedKey = "skill",
        action_key: NestedKey = "action",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
        network: Callable[..., nn.Module] = SkillMLP,
    ) -> None:
        action_key = unravel_key(action_key)
        low, high = _bounds(action_spec, action_key)
        prefix = () if isinstance(action_key, str) else action_key[:-1]
        loc_key, scale_key = (unravel_key((*prefix, name)) for name in ("loc", "scale"))
        size = low.shape[-1]
        net = network(in_features, 2 * size, num_skills, hidden, activation)
        keys = [*key_list("GaussianSkillActor", in_keys), skill_key]
        super().__init__(
            _GaussianNetwork(net, keys, [loc_key, scale_key]),
            in_keys={"loc": loc_key, "scale": scale_key},
            out_keys=[action_key],
            spec=Composite({action_key: Bounded(low, high, shape=low.shape, dtype=low.dtype)}),
            distribution_class=TanhNormal,
            distribution_kwargs={"low": low, "high": high},
            return_log_prob=False,
        )
        self.num_skills = num_skills
        self.skill_key = unravel_key(skill_key)
        self.action_key = action_key
        self._middle = (high + low) / 2
        self._half_range = (high - low) / 2

    @property
    def network(self) -> nn.Module:
        """The network that computes the raw parameters ``[*B, 2 D]`` of the Gaussian."""
        return self.module[0].network

    def choose(
        self, outputs: Tensor, deterministic: bool, generator: torch.Generator | None = None
    ) -> Tensor:
        """Returns actions for the network's outputs ``[*B, 2 D]``: squashed means, or samples."""
        loc, scale = self.module[0].extractor(outputs)
        if not deterministic:
            noise = torch.empty_like(loc).normal_(generator=generator)
            loc = loc + scale * noise
        half_range, middle = self._half_range.to(loc), self._middle.to(loc)
        return half_range * loc.tanh() + middle


class _GaussianNetwork(TensorDictModuleBase):
    """Runs a network on entries of a tensordict and writes the location and scale it gives."""

    def __init__(
        self, network: nn.Module, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]
    ) -> None:
        super().__init__()
        self.in_keys = key_list("GaussianSkillActor", in_keys)
        self.out_keys = list(out_keys)
        self.network = network
        self.extractor = NormalParamExtractor()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        outputs = self.network(*entries(self, tensordict, self.in_keys))
        for key, value in zip(self.out_keys, self.extractor(outputs), strict=True):
            tensordict.set(key, value)
        return tensordict


def _bounds(action_spec: TensorSpec, action_key: NestedKey) -> tuple[Tensor, Tensor]:
    """Returns the bounds of one action, each ``[D]``."""
    if isinstance(action_spec, Composite):
        action_spec = action_spec[action_key]
    if not isinstance(action_spec, Bounded) or not action_spec.dtype.is_floating_point:
        raise ValueError(
            "GaussianSkillActor squashes a Gaussian between bounds, so it needs a Bounded action "
            f"spec of floats; got {type(action_spec).__name__} of {action_spec.dtype}. Pass "
            "env.action_spec of a continuous env; for discrete actions use SkillActor."
        )
    if not action_spec.shape:
        raise ValueError(
            "GaussianSkillActor needs actions with a last dimension, e.g. shape (1,); got a spec "
            "of shape ()."
        )
    ends = []
    for bound in (action_spec.space.low, action_spec.space.high):
        flat = bound.expand(action_spec.shape).reshape(-1, action_spec.shape[-1])
        if not torch.isfinite(flat).all() or not (flat == flat[0]).all():
            raise ValueError(
                "GaussianSkillActor needs finite bounds that are the same for the whole batch; got "
                f"{bound.tolist()}."
            )
        ends.append(flat[0].clone())
    return ends[0], ends[1]
