"""Networks of a skill: shared layers with a head per skill, or with the skill as an input.

They run their layers by hand: calling a small module costs as much as what it computes, and the
weights may be those of N copies, stacked, as losses hold those of twin critics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import TensorSpec

from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.modules.skill_spec import Skills, as_skill_spec, described, number_of


class SkillMLP(nn.Module):
    r"""Maps features and a skill to outputs through shared layers and one head per skill.

    .. math:: y = W_z h(x) + b_z, \qquad h = \sigma(A_2 \sigma(A_1 x + a_1) + a_2)

    Letters: ``*B`` any batch shape, ``F`` ``in_features``, ``Z`` ``num_skills``, ``O``
    ``out_features``. All heads are computed in one product and the skill's own is gathered.

    Args:
        in_features (int): number of input features ``F``, after concatenation.
        out_features (int): number of outputs ``O`` of each head.
        num_skills (int or TensorSpec): number of skills ``Z``, one head each.
        hidden (sequence of int): widths of the shared layers. Default ``(64, 64)``: two layers, as
            in the dissertation.
        activation (callable): builds the activation after each shared layer.

    Returns:
        From ``forward(*features, skill)``: Tensor ``[*B, O]``. ``features`` are one or more tensors
        ``[*B, f_i]`` with ``sum f_i = F``; ``skill`` is int64 ``[*B]``. With the parameters of N
        copies stacked in place of its own, ``[N, *B, O]``.

    Raises:
        ValueError: if a size is not positive, there is no shared layer, or skills are vectors.

    Reference:
        Bartley, "Hierarchical Reinforcement Learning with Model-Based Planning for Finding Sparse
        Rewards", 2023, chapter 4.

    Examples:
        >>> from torchrl_hmcts.modules import SkillMLP
        >>> net = SkillMLP(in_features=3, out_features=2, num_skills=4)
        >>> net(torch.randn(5, 3), torch.tensor([0, 1, 2, 3, 0])).shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        num_skills: Skills,
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
    ) -> None:
        super().__init__()
        owner = type(self).__name__
        check_sizes(owner, in_features=in_features, out_features=out_features)
        self.in_features, self.out_features = in_features, out_features
        self.skill_spec = as_skill_spec(owner, num_skills)
        self.num_skills = number_of(self.skill_spec)
        self.skill_size = None if self.num_skills else self.skill_spec.shape[-1]  # of a vector
        self._build(owner, tuple(hidden), activation)

    def _build(
        self, owner: str, hidden: tuple[int, ...], activation: Callable[[], nn.Module]
    ) -> None:
        if not hidden:
            raise ValueError(f"{owner} needs a shared layer, e.g. hidden=(64, 64); got hidden=().")
        if self.num_skills is None:
            raise ValueError(
                f"{owner} has one head per skill, so it needs numbered skills; got "
                f"{described(self.skill_spec)}. Use ConcatSkillMLP, which reads vectors."
            )
        self.trunk = hidden_layers(owner, self.in_features, hidden, activation)
        self.heads = nn.Linear(hidden[-1], self.num_skills * self.out_features)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Returns the outputs of each element's own skill, ``[*B, O]``; see the class."""
        return self.run(self._weights(), *inputs)

    def run(self, weights: Sequence[Tensor], *inputs: Tensor) -> Tensor:
        """Does what ``forward`` does, with weights in place of the network's own.

        They are in the order of ``parameters()``; of N copies, stacked.
        """
        *features, skill = inputs
        check_skill(skill, features[0], self.skill_size)
        y = self._all_skills(weights, features)  # [*B, Z, O], of stacked weights [N, *B, Z, O]
        index = skill.unsqueeze(-1).unsqueeze(-1).expand(*y.shape[:-2], 1, self.out_features)
        if torch.compiler.is_compiling():
            return y.gather(-2, index).squeeze(-2)
        try:
            return y.gather(-2, index).squeeze(-2)
        except RuntimeError:
            refuse_unknown(skill, self.num_skills)
            raise

    def all_skills(self, *features: Tensor) -> Tensor:
        """Returns the outputs for every skill, ``[*B, Z, O]``."""
        return self._all_skills(self._weights(), features)

    def _all_skills(self, weights: Sequence[Tensor], features: Sequence[Tensor]) -> Tensor:
        y = run_layers(self.trunk, weights, concatenate(features))
        return y.view(*y.shape[:-1], self.num_skills or 1, self.out_features)

    def _weights(self) -> list[Tensor]:
        """Returns the network's own weights and biases, in the order of ``parameters()``."""
        *_, last = self.children()
        linear: list[Any] = [layer for layer in self.trunk if type(layer) is nn.Linear]
        return [tensor for layer in (*linear, last) for tensor in (layer.weight, layer.bias)]

    @property
    def stackable(self) -> bool:
        """True if the parameters of N copies may be put in stacked, to run all copies at once."""
        return can_stack(self.trunk)


class ConcatSkillMLP(SkillMLP):
    r"""Maps features and a skill to outputs by a network that reads the skill beside the features.

    .. math:: y = B h(x, e_z) + b, \qquad h = \sigma(A_2 \sigma(A_1 [x; e_z] + a_1) + a_2)

    with :math:`e_z` the one-hot skill, or a skill that is a vector as it is. It is built and called
    as :class:`SkillMLP` is: pass it as ``network=ConcatSkillMLP`` to an actor or critic. All layers
    are shared by all skills; there may be no hidden one.

    Args:
        num_skills (int or TensorSpec): number of skills ``Z``, or the spec of one skill that is a
            vector ``[D]``, e.g. :class:`UnitSphere`; ``skill`` is then float ``[*B, D]``.
        in_features, out_features, hidden, activation: as :class:`SkillMLP`'s.

    Returns:
        From ``forward(*features, skill)``: Tensor ``[*B, O]``.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070.

    Examples:
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.modules import ConcatSkillMLP, SkillActor
        >>> actor = SkillActor(3, Categorical(2), 4, in_keys=["velocity"], network=ConcatSkillMLP)
        >>> actor.network.trunk[0].in_features
        7
    """

    def _build(
        self, owner: str, hidden: tuple[int, ...], activation: Callable[[], nn.Module]
    ) -> None:
        width = self.in_features + (self.skill_size or self.num_skills or 0)
        self.trunk = hidden_layers(owner, width, hidden, activation)
        self.last = nn.Linear((width, *hidden)[-1], self.out_features)

    def run(self, weights: Sequence[Tensor], *inputs: Tensor) -> Tensor:
        *features, skill = inputs
        check_skill(skill, features[0], self.skill_size)
        if self.num_skills is not None:
            if skill.device.type == "cpu" and not torch.compiler.is_compiling():
                refuse_unknown(skill, self.num_skills)  # its one-hot would be zeros
            skill = self._one_hot(skill, features[0])
        return run_layers(self.trunk, weights, torch.cat((*features, skill), -1))

    def all_skills(self, *features: Tensor) -> Tensor:
        if self.num_skills is None:
            raise ValueError(
                f"{type(self).__name__} cannot return its outputs for every skill: its skills are "
                f"{described(self.skill_spec)}. Call it with skills."
            )
        x = torch.cat(features, -1).unsqueeze(-2)
        x = x.expand(*x.shape[:-2], self.num_skills, -1)
        skill = torch.arange(self.num_skills, device=x.device)
        one_hot = self._one_hot(skill, x).expand(*x.shape[:-1], -1)
        return run_layers(self.trunk, self._weights(), torch.cat((x, one_hot), -1))

    def _one_hot(self, skill: Tensor, like: Tensor) -> Tensor:
        skills = torch.arange(self.num_skills or 0, device=like.device)
        return (skill.unsqueeze(-1) == skills).to(like.dtype)


def skill_network(
    network: Callable[..., nn.Module], in_features: int, size: int, skills: Skills, *args: Any
) -> Any:
    """Builds the network of an actor or critic; vectors are read, by no heads of their own."""
    if isinstance(skills, TensorSpec) and network is SkillMLP:
        if number_of(as_skill_spec("ConcatSkillMLP", skills)) is None:
            network = ConcatSkillMLP
    return network(in_features, size, skills, *args)


class FeatureMLP(nn.Sequential):
    """A multi-layer perceptron without a skill; it concatenates its inputs first."""

    def __init__(
        self,
        owner: str,
        sizes: Sequence[int],
        activation: Callable[[], nn.Module] = nn.ReLU,
        linear: Callable[[int, int], nn.Module] = nn.Linear,
    ) -> None:
        hidden = hidden_layers(owner, sizes[0], sizes[1:-1], activation, linear)
        super().__init__(*hidden, linear(sizes[-2], sizes[-1]))

    def forward(self, *features: Tensor) -> Tensor:
        return super().forward(fitting(concatenate(features), next(self.parameters())))

    def run(self, weights: Sequence[Tensor], *features: Tensor) -> Tensor:
        """Does what ``forward`` does, with weights in place of its own, as :meth:`SkillMLP.run`."""
        return run_layers(list(self)[:-1], weights, concatenate(features))

    @property
    def stackable(self) -> bool:
        """True if :meth:`run` can be used."""
        return can_stack(self)


class SkillNetwork(TensorDictModuleBase):
    """Runs a network on the entries ``in_keys`` of a tensordict and writes its output.

    ``tensordict.nn.TensorDictModule`` does the same for any signature and costs about 200 us a
    call; this one costs what its network costs.
    """

    network: nn.Module

    def __init__(
        self, network: nn.Module, in_keys: Sequence[NestedKey], *out_keys: NestedKey
    ) -> None:
        super().__init__()
        self.in_keys = key_list(type(self).__name__, in_keys)
        self.out_keys = [unravel_key(key) for key in out_keys]
        self.out_key = self.out_keys[0]
        self.network = network

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the network's output, of the shape the network gives."""
        inputs = entries(self, tensordict, self.in_keys)
        return tensordict.set(self.out_key, self.network(*inputs))


def concatenate(features: Sequence[Tensor]) -> Tensor:
    """Returns features side by side, without a copy of a single one."""
    return features[0] if len(features) == 1 else torch.cat(tuple(features), -1)


def hidden_layers(
    owner: str,
    in_features: int,
    hidden: Sequence[int],
    activation: Callable[[], nn.Module],
    linear: Callable[[int, int], nn.Module] = nn.Linear,
) -> nn.Sequential:
    """Builds the hidden layers of a network, each a linear map and an activation."""
    layers: list[nn.Module] = []
    for width in hidden:
        whole_number(owner, f"each width in hidden={tuple(hidden)}", width, least=1)
        layers += [linear(in_features, width), activation()]
        in_features = width
    return nn.Sequential(*layers)


def run_layers(hidden: Iterable[nn.Module], weights: Sequence[Tensor], x: Tensor) -> Tensor:
    """Runs x ``[*B, F]`` through hidden layers and a last one; of N stacked copies, ``[N, *B, O]``.

    Layers are applied here, not called as modules, with ``weights`` in the order of parameters.
    """
    x = fitting(x, weights[0])
    num_nets = weights[-1].shape[:-1]  # () or, stacked, (N,)
    batch = x.shape[:-1]
    if num_nets:
        x = x.reshape(1, -1, x.shape[-1]).expand(*num_nets, -1, -1)
    i = 0
    for layer in hidden:
        if type(layer) is nn.Linear:
            x = _linear(weights[i], weights[i + 1], x)
            i += 2
        else:
            x = x.relu() if type(layer) is nn.ReLU else layer(x)
    y = _linear(weights[i], weights[i + 1], x)
    return y.view(*num_nets, *batch, y.shape[-1]) if num_nets else y


def _linear(weight: Tensor, bias: Tensor, x: Tensor) -> Tensor:
    """Applies a linear layer, or N stacked ones (weight ``[N, O, I]``) to x ``[N, b, I]``."""
    if weight.ndim == 2:
        return F.linear(x, weight, bias)
    return torch.baddbmm(bias.unsqueeze(-2), x, weight.transpose(-2, -1))


def can_stack(layers: Iterable[nn.Module]) -> bool:
    """Returns whether stacked parameters can be run: none but linear layers may have any."""
    others = [layer for layer in layers if type(layer) is not nn.Linear]
    # Not by their state dicts, which torch.compile cannot trace.
    return not any(True for layer in others for _ in (*layer.parameters(), *layer.buffers()))


def fitting(x: Tensor, weight: Tensor) -> Tensor:
    """Returns features ``[*B, F]`` in the precision of a first layer's weights ``[O, F]``.

    MuJoCo's observations are float64.

    Raises:
        ValueError: if they are others, or no floats.
    """
    if x.shape[-1] != weight.shape[-1] or not x.is_floating_point():
        fix = f"Build it with in_features={x.shape[-1]}, or give it other in_keys."
        if x.shape[-1] == weight.shape[-1]:
            fix = f"Append DTypeCastTransform({x.dtype}, {weight.dtype}, in_keys=...) to the env."
        raise ValueError(
            f"A network for {weight.shape[-1]} features of {weight.dtype} was given "
            f"{x.shape[-1]} of {x.dtype}, the entries of its in_keys side by side. {fix}"
        )
    return x if x.dtype == weight.dtype else x.to(weight.dtype)


def check_skill(skill: Tensor, features: Tensor, size: int | None) -> None:
    """Raises ValueError unless skills fit features ``[*B, f]``: int64 ``[*B]``, or vectors."""
    if size is not None:
        right = (*features.shape[:-1], size)
        if skill.shape != right or not skill.is_floating_point():
            raise ValueError(
                f"Skills must be vectors, floats {list(right)} for features "
                f"{list(features.shape)}; got {skill.dtype} {list(skill.shape)}. Give the "
                f"SkillTransform their spec, or the OptionTransform skills=, a table of vectors."
            )
        return
    if skill.dtype not in (torch.int64, torch.int32) or skill.shape != features.shape[:-1]:
        raise ValueError(
            f"Skills must be indices, int64 {list(features.shape[:-1])} for features "
            f"{list(features.shape)}; got {skill.dtype} {list(skill.shape)}. One-hot skills become "
            f"indices by skill.long().argmax(-1)."
        )


def refuse_unknown(skill: Tensor, num_skills: int | None) -> None:
    """Raises ValueError if there is a skill that does not exist."""
    if num_skills is None or not skill.numel():
        return
    low, high = map(int, torch.aminmax(skill))
    if low < 0 or high >= num_skills:
        raise ValueError(
            f"Skill {low if low < 0 else high} does not exist: a network of "
            f"num_skills={num_skills} knows 0 to {num_skills - 1}. Make the SkillTransform or "
            "OptionTransform with the same number."
        )


def check_sizes(owner: str, **sizes: int) -> None:
    """Raises an error that names the first size that is no positive whole number."""
    for name, size in sizes.items():
        whole_number(owner, name, size, least=1)


def entries(owner: object, tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> list[Tensor]:
    """Returns entries of a tensordict, for a module or loss; KeyError names one that is missing."""
    found = [tensordict.get(key, None) for key in keys]
    if any(entry is None for entry in found):
        missing = [key for key, entry in zip(keys, found, strict=True) if entry is None]
        raise KeyError(
            f"{type(owner).__name__} reads {missing[0]!r}, which is missing; there are "
            f"{sorted(map(str, tensordict.keys(True, True)))}. Give it other keys, or let the env "
            f"write the entry; a SkillTransform or OptionTransform writes the skill."
        )
    return found


def key_list(owner: str, keys: Sequence[NestedKey] | NestedKey) -> list[NestedKey]:
    """Returns the keys as a list of unravelled keys; a lone string is one key."""
    listed = [keys] if isinstance(keys, str) else list(keys)
    if not listed:
        raise ValueError(
            f"{owner} needs at least one in_key to read its features from; got {keys!r}. "
            "Pass e.g. in_keys=['velocity']."
        )
    return [unravel_key(key) for key in listed]
