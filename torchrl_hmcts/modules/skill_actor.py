"""The skill-conditioned actor, for losses and, stripped to its network, for use inside options."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModuleBase
from tensordict.nn.probabilistic import interaction_type
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data import (
    Binary,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
)
from torchrl.modules import OneHotCategorical, ProbabilisticActor, ReparamGradientStrategy

from torchrl_hmcts.modules.skill_mlp import SkillMLP, SkillNetwork, entries, key_list


class _Categorical(torch.distributions.Categorical):
    """PyTorch's, whose mean is not a number: for ``ExplorationType.MEAN`` it is the mode here."""

    @property
    def mean(self) -> Tensor:
        return self.mode

    @property
    def deterministic_sample(self) -> Tensor:
        return self.mode


class _OneHotCategorical(OneHotCategorical):
    """TorchRL's, which takes the logits ``[B, 1]`` of a single action for those of B actions."""

    @property
    def mean(self) -> Tensor:
        return self.mode

    def __init__(
        self,
        logits: Tensor | None = None,
        probs: Tensor | None = None,
        grad_method: ReparamGradientStrategy = ReparamGradientStrategy.PassThrough,
        **kwargs: Any,
    ) -> None:
        given = probs if logits is None else logits
        if given is None or given.shape[-1] != 1:
            super().__init__(logits, probs, grad_method, **kwargs)
            return
        torch.distributions.Categorical.__init__(self, probs, logits, **kwargs)
        self.grad_method, self.num_samples = grad_method, 1


def is_to_sample(deterministic: bool) -> bool:
    """Return whether to sample: where nobody says otherwise, the caller or the exploration type."""
    return not deterministic and interaction_type() in (None, InteractionType.RANDOM)


class SkillActor(ProbabilisticActor):
    r"""A discrete policy pi(a | s, z) with shared layers and one head per skill.

    .. math:: \pi(a \mid s, z) = \mathrm{softmax}_a(\mathrm{SkillMLP}(s, z))

    It is the actor TorchRL's discrete losses want (a ``ProbabilisticTensorDictSequential``). Inside
    options use the lean :class:`SkillPolicy` over the same parameters.

    Args:
        in_features (int): summed sizes of the entries ``in_keys``.
        action_spec (TensorSpec): the env's action spec, a ``Categorical`` (action int64 ``[*B]``)
            or a ``OneHot`` (action ``[*B, A]``) with ``A`` actions.
        num_skills (int): number of skills.
        in_keys (sequence of NestedKey): observation entries ``[*B, f_i]``, concatenated in order.
        skill_key (NestedKey): entry of the skill, int64 ``[*B]``. Default ``"skill"``.
        action_key (NestedKey): entry the action is written to. Default ``"action"``.
        hidden (sequence of int): widths of the shared layers. Default ``(64, 64)``.
        activation (callable): builds the activations. Default ``torch.nn.ReLU``.
        network (callable): builds the network, with the signature of :class:`SkillMLP`. Default
            :class:`SkillMLP`; e.g. :class:`ConcatSkillMLP` for a skill that is concatenated.

    Raises:
        ValueError: if the action spec is neither ``Categorical`` nor ``OneHot``.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070; Bartley 2023, ch. 4.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.modules import SkillActor
        >>> actor = SkillActor(2, Categorical(4), num_skills=3, in_keys=["velocity"])
        >>> td = TensorDict(velocity=torch.randn(5, 2), skill=torch.zeros(5, dtype=torch.int64),
        ...                 batch_size=[5])
        >>> actor(td)["action"].shape
        torch.Size([5])
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
        spec, one_hot = _leaf_spec(action_spec, action_key)
        num_actions = int(spec.space.n)
        action_key = unravel_key(action_key)
        logits_key = "logits" if isinstance(action_key, str) else (*action_key[:-1], "logits")
        net = network(in_features, num_actions, num_skills, hidden, activation)
        keys = [*key_list("SkillActor", in_keys), skill_key]
        super().__init__(
            SkillNetwork(net, keys, logits_key),
            in_keys={"logits": logits_key},
            out_keys=[action_key],
            spec=Composite({action_key: spec}),
            distribution_class=_OneHotCategorical if one_hot else _Categorical,
            return_log_prob=False,
        )
        self.num_skills = num_skills
        self.num_actions = num_actions
        self.one_hot = one_hot
        self.action_dtype = spec.dtype
        self.skill_key = unravel_key(skill_key)
        self.action_key = action_key

    @property
    def network(self) -> nn.Module:
        """The network that computes the action logits from the features and the skill."""
        return self.module[0].network

    def choose(
        self, logits: Tensor, deterministic: bool, generator: torch.Generator | None = None
    ) -> Tensor:
        """Returns actions for the network's outputs ``[*B, A]``: the best ones, or samples."""
        if not deterministic:
            # Gumbel-max: argmax(logits - log E) with E exponential is a draw from softmax(logits).
            noise = torch.empty_like(logits).exponential_(generator=generator)
            logits = logits - noise.log_()
        action = logits.argmax(-1)
        if self.one_hot:
            action = nn.functional.one_hot(action, self.num_actions).to(self.action_dtype)
        return action


class SkillPolicy(TensorDictModuleBase):
    """Acts like a skill actor at a fraction of its cost, sharing its parameters.

    No distribution objects, no spec checks, no gradients: it reads the features and the skill and
    writes the action. That makes it the worker to run inside options and the collection policy of
    the trainer, for discrete and for continuous actions.

    Args:
        actor (SkillActor or GaussianSkillActor): the actor whose parameters are used; later updates
            are seen.
        deterministic (bool): take the most probable action (of a Gaussian: its mean, squashed)
            instead of sampling, whatever the exploration type. Default ``False``: sample, unless
            TorchRL's ``set_exploration_type`` asks for ``DETERMINISTIC``, ``MODE`` or ``MEAN``,
            which mean the same here.
        generator (torch.Generator, optional): source of the samples. Default ``None``: torch's
            global one.

    Returns:
        From ``forward(tensordict)``: the same, with the action of each row: int64 ``[*B]``
        (one-hot: ``[*B, A]``; continuous: ``[*B, D]``).

    Raises:
        TypeError: if ``actor`` is none of the two.

    Reference:
        This project's.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.modules import SkillActor, SkillPolicy
        >>> actor = SkillActor(2, Categorical(4), num_skills=3, in_keys=["velocity"])
        >>> policy = SkillPolicy(actor, deterministic=True)
        >>> td = TensorDict(velocity=torch.randn(5, 2), skill=torch.zeros(5, dtype=torch.int64),
        ...                 batch_size=[5])
        >>> policy(td)["action"].dtype
        torch.int64
    """

    def __init__(
        self,
        actor: ProbabilisticActor,
        *,
        deterministic: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if not (hasattr(actor, "choose") and hasattr(actor, "network")):
            raise TypeError(
                "SkillPolicy runs the network of a SkillActor or GaussianSkillActor without its "
                f"distribution; got {type(actor).__name__}. Pass one of these, or use your module "
                "itself as policy."
            )
        self.network = actor.network
        self.num_skills = actor.num_skills
        self.in_keys = list(actor.module[0].in_keys)
        self.out_keys = [actor.action_key]
        self.action_key = actor.action_key
        self.deterministic = bool(deterministic)
        self.generator = generator
        self._choose = actor.choose

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of each row's skill."""
        outputs = self.network.forward(*entries(self, tensordict, self.in_keys))
        deterministic = not is_to_sample(self.deterministic)
        action = self._choose(outputs, deterministic, self.generator)
        return tensordict.set(self.action_key, action)


def _leaf_spec(action_spec: TensorSpec, action_key: NestedKey) -> tuple[TensorSpec, bool]:
    """Returns the unbatched leaf spec and whether it is one-hot."""
    if isinstance(action_spec, Composite) and action_key in action_spec.keys(True, True):
        action_spec = action_spec[action_key]
    several = isinstance(action_spec, (Binary, MultiCategorical, MultiOneHot))
    if isinstance(action_spec, OneHot) and not several:
        return OneHot(int(action_spec.space.n), dtype=action_spec.dtype), True
    if isinstance(action_spec, Categorical) and not several:
        return Categorical(int(action_spec.space.n)), False
    raise ValueError(
        "SkillActor chooses among a fixed number of actions, so it needs a Categorical or OneHot "
        f"action spec; got {type(action_spec).__name__}. Pass env.action_spec of a discrete env; "
        "for continuous actions use GaussianSkillActor."
    )
