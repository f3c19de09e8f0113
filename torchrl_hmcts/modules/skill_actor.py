"""The skill-conditioned actor, its lean policy for use inside options, and the critics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, NormalParamExtractor, TensorDictModuleBase
from tensordict.nn.probabilistic import interaction_type
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical, Composite, OneHot, TensorSpec
from torchrl.modules import (
    OneHotCategorical,
    ProbabilisticActor,
    ReparamGradientStrategy,
    TanhNormal,
)

from torchrl_hmcts.checks import instance
from torchrl_hmcts.modules.skill_mlp import (
    SkillMLP,
    SkillNetwork,
    check_sizes,
    entries,
    key_list,
    skill_network,
)
from torchrl_hmcts.modules.skill_spec import Skills, as_skill_spec, number_of


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
    """Return whether to sample: as the caller says, or the exploration type."""
    return not deterministic and interaction_type() in (None, InteractionType.RANDOM)


class _Choice:
    """One of A actions, from A logits."""

    writes = ("logits",)
    distribution_kwargs: dict[str, Any] = {}

    def __init__(self, spec: TensorSpec) -> None:
        self.size = self.num_actions = int(spec.space.n)
        self.one_hot = isinstance(spec, OneHot)
        self.distribution: type = _OneHotCategorical if self.one_hot else _Categorical
        self.spec = OneHot(self.size, dtype=spec.dtype) if self.one_hot else Categorical(self.size)

    def choose(
        self, logits: Tensor, deterministic: bool, generator: torch.Generator | None
    ) -> Tensor:
        if not deterministic:
            # Gumbel-max: argmax(logits - log E) with E exponential is a draw from softmax(logits).
            noise = torch.empty_like(logits).exponential_(generator=generator)
            logits = logits - noise.log_()
        action = logits.argmax(-1)
        if self.one_hot:
            action = nn.functional.one_hot(action, self.size).to(self.spec.dtype)
        return action


class _TanhNormal(TanhNormal):
    """TorchRL's, whose samples have the dtype of the bounds, also where the network's is less."""

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        return super().rsample(sample_shape).to(self.low.dtype)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return super().sample(sample_shape).to(self.low.dtype)

    @property
    def deterministic_sample(self) -> Tensor:
        return super().deterministic_sample.to(self.low.dtype)


class _Squashed:
    """An action between bounds ``[D]``, from the 2 D raw parameters of a Gaussian."""

    writes = ("loc", "scale")
    distribution = _TanhNormal

    def __init__(self, spec: Bounded) -> None:
        ends = torch.stack((spec.space.low, spec.space.high)).expand(2, *spec.shape)
        flat = ends.reshape(2, -1, spec.shape[-1])
        if not flat.isfinite().all() or not (flat == flat[:, :1]).all():
            raise ValueError(
                "SkillActor needs an action_spec of finite bounds, the same for the whole "
                f"batch; got {ends.tolist()}."
            )
        low, high = flat[:, 0].clone()
        self.size = 2 * low.shape[-1]
        self.spec = Bounded(low, high, shape=low.shape, dtype=low.dtype)
        self.distribution_kwargs = {"low": low, "high": high}
        self.middle, self.half_range = (high + low) / 2, (high - low) / 2

    def choose(
        self, outputs: Tensor, deterministic: bool, generator: torch.Generator | None
    ) -> Tensor:
        loc, scale = _gaussian(outputs)
        if not deterministic:
            loc = loc + scale * torch.empty_like(loc).normal_(generator=generator)
        action = self.half_range.to(loc) * loc.tanh() + self.middle.to(loc)
        return action.to(self.spec.dtype)


_gaussian = NormalParamExtractor()


class _GaussianNetwork(SkillNetwork):
    """Writes the location and scale that a network's outputs stand for."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        outputs = self.network(*entries(self, tensordict, self.in_keys))
        for key, value in zip(self.out_keys, _gaussian(outputs), strict=True):
            tensordict.set(key, value)
        return tensordict


class SkillActor(ProbabilisticActor):
    r"""A policy pi(a | s, z) with shared layers and one head per skill.

    .. math:: \pi(a \mid s, z) = \mathrm{softmax}_a(\mathrm{SkillMLP}(s, z))

    for discrete actions. For continuous ones it is a squashed Gaussian, with :math:`l, h` the
    bounds of the action:

    .. math::

        a = \tfrac{h - l}{2} \tanh(u) + \tfrac{h + l}{2}, \qquad
        u \sim \mathcal{N}(\mu, \sigma^2), \qquad (\mu, \sigma) = \mathrm{SkillMLP}(s, z)

    Losses take it as it is. Inside options use the lean :class:`SkillPolicy` over its parameters.

    Args:
        in_features (int): summed sizes of the entries ``in_keys``.
        action_spec (TensorSpec): the env's action spec: a ``Categorical`` (action int64 ``[*B]``)
            or ``OneHot`` (action ``[*B, A]``) with ``A`` actions, or a ``Bounded`` of floats with
            the last dimension ``D`` (action ``[*B, D]``); leading (batch) dimensions must have the
            same bounds.
        num_skills (int or TensorSpec): number of skills, or the spec of one skill that is a vector
            ``[D]``, e.g. :class:`UnitSphere`.
        in_keys (sequence of NestedKey): observation entries ``[*B, f_i]``, concatenated in order.
        skill_key (NestedKey): entry of the skill, int64 ``[*B]``, or float ``[*B, D]``.
        action_key (NestedKey): entry the action is written to. Default ``"action"``.
        hidden (sequence of int): widths of the shared layers. Default ``(64, 64)``.
        activation (callable): builds the activations. Default ``torch.nn.ReLU``.
        network (callable): builds the network, with the signature of :class:`SkillMLP`. Default
            :class:`SkillMLP`; e.g. :class:`ConcatSkillMLP` for a skill that is concatenated, which
            a vector always is.

    Raises:
        ValueError: if the action spec is none of these, or its bounds are not finite.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070; Bartley 2023, ch. 4.
        Squashing: Haarnoja et al., "Soft Actor-Critic", 2018, arXiv 1801.01290, appendix C.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded, Categorical
        >>> from torchrl_hmcts.modules import SkillActor
        >>> td = TensorDict(velocity=torch.randn(5, 2), skill=torch.zeros(5, dtype=torch.int64),
        ...                 batch_size=[5])
        >>> for spec in (Categorical(4), Bounded(-1.0, 1.0, shape=(3,))):
        ...     actor = SkillActor(2, spec, num_skills=3, in_keys=["velocity"])
        ...     print(actor(td)["action"].shape)
        torch.Size([5])
        torch.Size([5, 3])
    """

    def __init__(
        self,
        in_features: int,
        action_spec: TensorSpec,
        num_skills: Skills,
        *,
        in_keys: Sequence[NestedKey],
        skill_key: NestedKey = "skill",
        action_key: NestedKey = "action",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
        network: Callable[..., nn.Module] = SkillMLP,
    ) -> None:
        action_key = unravel_key(action_key)
        kind = _kind_of_action(action_spec, action_key)
        group = () if isinstance(action_key, str) else action_key[:-1]
        written = [unravel_key((*group, name)) for name in kind.writes]
        net = skill_network(network, in_features, kind.size, num_skills, hidden, activation)
        keys = [*key_list("SkillActor", in_keys), skill_key]
        run = (SkillNetwork if isinstance(kind, _Choice) else _GaussianNetwork)(net, keys, *written)
        super().__init__(
            run,
            in_keys=dict(zip(kind.writes, written, strict=True)),
            out_keys=[action_key],
            spec=Composite({action_key: kind.spec}),
            distribution_class=kind.distribution,
            distribution_kwargs=kind.distribution_kwargs,
            return_log_prob=False,
        )
        self.skill_spec = as_skill_spec("SkillActor", num_skills)
        self.num_skills = number_of(self.skill_spec)
        if isinstance(kind, _Choice):
            self.num_actions = kind.num_actions
        self.skill_key = unravel_key(skill_key)
        self.action_key = action_key
        self.choose = kind.choose  # actions for the network's outputs: the best ones, or samples

    @property
    def network(self) -> nn.Module:
        """The network that computes the logits or the raw parameters of the Gaussian."""
        return self.module[0].network


def _kind_of_action(spec: TensorSpec, action_key: NestedKey) -> _Choice | _Squashed:
    """Returns how an action of a spec is made of a network's outputs."""
    if isinstance(spec, Composite) and action_key in spec.keys(True, True):
        spec = spec[action_key]
    if type(spec) in (Categorical, OneHot):  # and not of several choices, which are subclasses
        return _Choice(spec)
    has_size = isinstance(spec, Bounded) and spec.shape and spec.shape.numel()
    if has_size and spec.dtype.is_floating_point:
        return _Squashed(spec)
    raise ValueError(
        "SkillActor chooses among a fixed number of actions or within bounds, so it needs a "
        "Categorical or OneHot action spec, or a Bounded one of floats with a last dimension; got "
        f"{type(spec).__name__}"
        + (f" of {spec.dtype}, shape {tuple(spec.shape)}" if isinstance(spec, Bounded) else "")
        + ". Pass env.action_spec."
    )


class SkillPolicy(TensorDictModuleBase):
    """Acts like a skill actor at a fraction of its cost, sharing its parameters.

    The worker to run inside options and to collect with: no distributions, spec checks, gradients.

    Args:
        actor (SkillActor): the actor whose parameters are used; later updates are seen.
        deterministic (bool): take the most probable action (of a Gaussian: its mean, squashed)
            instead of sampling, under any exploration type. Default ``False``: sample, unless
            TorchRL's ``set_exploration_type`` asks for ``DETERMINISTIC``, ``MODE`` or ``MEAN``,
            which mean the same here.
        generator (torch.Generator, optional): source of the samples. Default ``None``: torch's
            global one.

    Returns:
        From ``forward(tensordict)``: the same, with the action of each row: int64 ``[*B]``
        (one-hot: ``[*B, A]``; continuous: ``[*B, D]``).

    Reference:
        This project's.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.modules import SkillActor, SkillPolicy
        >>> actor = SkillActor(2, Categorical(4), num_skills=3, in_keys=["velocity"])
        >>> policy = SkillPolicy(actor, deterministic=True)
        >>> td = TensorDict(velocity=torch.randn(5, 2), skill=torch.zeros(5, dtype=torch.int64),
        ...                 batch_size=[5])
        >>> torch.equal(policy(td)["action"], actor.get_dist(td).mode)
        True
    """

    def __init__(
        self,
        actor: SkillActor,
        *,
        deterministic: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        instance("SkillPolicy", "actor", actor, SkillActor)
        self.__dict__["actor"] = actor  # no sub-module: its parameters are the network's
        self.network = actor.network
        self.num_skills, self.skill_spec = actor.num_skills, actor.skill_spec
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


class SkillCritic(SkillNetwork):
    r"""Values Q(s, z, .) of discrete actions with shared layers and one head per skill.

    .. math:: Q(s, z, \cdot) = \mathrm{SkillMLP}(s, z) \in \mathbb{R}^A

    Pass one to a loss; TorchRL makes the twin (and the targets) from it.

    Args:
        num_actions (int): number of actions ``A``.
        in_features, num_skills, in_keys, skill_key: as :class:`SkillActor`'s.
        hidden, activation, network: so are these.
        action_value_key (NestedKey): entry written, ``[*B, A]``. Default ``"action_value"``.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070; heads: Bartley, 2023,
        chapter 4.

    Examples:
        >>> from torchrl_hmcts.modules import SkillCritic
        >>> SkillCritic(2, num_actions=4, num_skills=3, in_keys=["velocity"]).in_keys
        ['velocity', 'skill']
    """

    def __init__(
        self,
        in_features: int,
        num_actions: int,
        num_skills: Skills,
        *,
        in_keys: Sequence[NestedKey],
        skill_key: NestedKey = "skill",
        action_value_key: NestedKey = "action_value",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
        network: Callable[..., nn.Module] = SkillMLP,
    ) -> None:
        check_sizes("SkillCritic", in_features=in_features, num_actions=num_actions)
        net = skill_network(network, in_features, num_actions, num_skills, hidden, activation)
        keys = [*key_list("SkillCritic", in_keys), skill_key]
        super().__init__(net, keys, action_value_key)
        self.num_actions = num_actions
        self.skill_spec = as_skill_spec("SkillCritic", num_skills)
        self.num_skills = number_of(self.skill_spec)


class SkillActionCritic(SkillNetwork):
    r"""The value Q(s, z, a) of a continuous action with shared layers and one head per skill.

    .. math:: Q(s, z, a) = \mathrm{SkillMLP}([s; a], z) \in \mathbb{R}

    Args:
        in_features (int): summed sizes of the entries ``in_keys``, without the action.
        action_features (int): size of the action, ``D``.
        num_skills, in_keys, skill_key, hidden, activation, network: as :class:`SkillActor`'s.
        action_key (NestedKey): entry of the action, ``[*B, D]``. Default ``"action"``.
        state_action_value_key (NestedKey): entry written, ``[*B, 1]``.

    Reference:
        As :class:`SkillCritic`.

    Examples:
        >>> from torchrl_hmcts.modules import SkillActionCritic
        >>> SkillActionCritic(3, action_features=2, num_skills=4, in_keys=["velocity"]).in_keys
        ['velocity', 'action', 'skill']
    """

    def __init__(
        self,
        in_features: int,
        action_features: int,
        num_skills: Skills,
        *,
        in_keys: Sequence[NestedKey],
        skill_key: NestedKey = "skill",
        action_key: NestedKey = "action",
        state_action_value_key: NestedKey = "state_action_value",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
        network: Callable[..., nn.Module] = SkillMLP,
    ) -> None:
        check_sizes("SkillActionCritic", in_features=in_features, action_features=action_features)
        width = in_features + action_features
        net = skill_network(network, width, 1, num_skills, hidden, activation)
        keys = [*key_list("SkillActionCritic", in_keys), action_key, skill_key]
        super().__init__(net, keys, state_action_value_key)
        self.skill_spec = as_skill_spec("SkillActionCritic", num_skills)
        self.num_skills = number_of(self.skill_spec)
