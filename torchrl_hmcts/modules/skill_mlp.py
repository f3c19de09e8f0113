"""A multi-layer perceptron with shared layers and one output head per skill."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.nn import functional as F


class SkillMLP(nn.Module):
    r"""Maps features and a skill to outputs through shared layers and one head per skill.

    .. math:: y = W_z h(x) + b_z, \qquad h = \sigma(A_2 \sigma(A_1 x + a_1) + a_2)

    Letters: ``*B`` any batch shape, ``F`` ``in_features``, ``Z`` ``num_skills``, ``O``
    ``out_features``. All heads are computed in one matrix product and the skill's own is gathered:
    for the usual handful of skills that is faster than picking weights per element, and it can be
    vmapped, as TorchRL's losses do with an ensemble of critics.

    Args:
        in_features (int): number of input features ``F``, after concatenation.
        out_features (int): number of outputs ``O`` of each head.
        num_skills (int): number of skills ``Z``, one head each.
        hidden (sequence of int): widths of the shared layers. Default ``(64, 64)``: two layers, as
            in the source.
        activation (callable): builds the activation after each shared layer. Default
            ``torch.nn.ReLU``.

    Returns:
        From ``forward(*features, skill)``: Tensor ``[*B, O]``. ``features`` are one or more tensors
        ``[*B, f_i]`` with ``sum f_i = F``; ``skill`` is int64 ``[*B]``. With the parameters of N
        copies stacked in place of its own, as losses hold those of twin critics, ``[N, *B, O]``.

    Raises:
        ValueError: if a size is not positive or there is no shared layer.

    Reference:
        Bartley, "Hierarchical Reinforcement Learning with Model-Based Planning for Finding Sparse
        Rewards", 2023, chapter 4.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.modules import SkillMLP
        >>> net = SkillMLP(in_features=3, out_features=2, num_skills=4)
        >>> net(torch.randn(5, 3), torch.tensor([0, 1, 2, 3, 0])).shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        num_skills: int,
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
    ) -> None:
        super().__init__()
        check_positive(
            "SkillMLP",
            in_features=in_features,
            out_features=out_features,
            num_skills=num_skills,
        )
        if not hidden:
            raise ValueError(
                "SkillMLP needs at least one shared layer, which the heads read; got hidden=(). "
                "Pass e.g. hidden=(64, 64)."
            )
        self.in_features = int(in_features)
        self.out_features = int(out_features)
        self.num_skills = int(num_skills)
        self.trunk = shared_layers("SkillMLP", in_features, hidden, activation)
        self.heads = nn.Linear(hidden[-1], num_skills * out_features)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Returns the outputs of each element's own skill, ``[*B, O]``; see the class."""
        return self.run(own_weights(self.trunk, self.heads), *inputs)

    def run(self, weights: Sequence[Tensor], *inputs: Tensor) -> Tensor:
        """Does what ``forward`` does, with weights in place of the network's own.

        They are in the order of ``parameters()``; of N copies, stacked.
        """
        *features, skill = inputs
        check_skill(skill, features[0])
        y = self._all_skills(weights, features)  # [*B, Z, O], of stacked weights [N, *B, Z, O]
        index = skill.unsqueeze(-1).unsqueeze(-1).expand(*y.shape[:-2], 1, self.out_features)
        return y.gather(-2, index).squeeze(-2)

    def all_skills(self, *features: Tensor) -> Tensor:
        """Returns the outputs for every skill, ``[*B, Z, O]``."""
        return self._all_skills(own_weights(self.trunk, self.heads), features)

    def _all_skills(self, weights: Sequence[Tensor], features: Sequence[Tensor]) -> Tensor:
        x = _concatenate(features)
        y = run_layers(self.trunk._modules.values(), weights, x)
        return y.view(*y.shape[:-1], self.num_skills, self.out_features)

    @property
    def stackable(self) -> bool:
        """Whether the parameters of N copies may be put in stacked, to run all copies at once."""
        return can_stack(self.trunk)

    def extra_repr(self) -> str:
        """Returns the sizes that ``print`` shows."""
        return f"num_skills={self.num_skills}, out_features={self.out_features}"


class ConcatSkillMLP(nn.Module):
    r"""Maps features and a skill to outputs by a network that reads the skill beside the features.

    .. math:: y = B h(x, e_z) + b, \qquad h = \sigma(A_2 \sigma(A_1 [x; e_z] + a_1) + a_2)

    with :math:`e_z` the one-hot skill. A drop-in replacement of :class:`SkillMLP`: pass it as
    ``network=ConcatSkillMLP`` to an actor or critic. All layers are shared by all skills, as in the
    paper on DIAYN; its number of weights hardly grows with the number of skills.

    Args:
        in_features (int): number of input features ``F``, after concatenation, without the skill.
        out_features (int): number of outputs ``O``.
        num_skills (int): number of skills ``Z``.
        hidden (sequence of int): widths of the hidden layers. Default ``(64, 64)``.
        activation (callable): builds the activation after each hidden layer. Default
            ``torch.nn.ReLU``.

    Returns:
        From ``forward(*features, skill)``: Tensor ``[*B, O]``, as :class:`SkillMLP`.

    Raises:
        ValueError: if a size is not positive.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070.

    Examples:
        >>> import torch
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.modules import ConcatSkillMLP, SkillActor
        >>> net = ConcatSkillMLP(in_features=3, out_features=2, num_skills=4)
        >>> net(torch.randn(5, 3), torch.tensor([0, 1, 2, 3, 0])).shape
        torch.Size([5, 2])
        >>> actor = SkillActor(3, Categorical(2), 4, in_keys=["velocity"], network=ConcatSkillMLP)
        >>> type(actor.network).__name__
        'ConcatSkillMLP'
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        num_skills: int,
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
    ) -> None:
        super().__init__()
        name = "ConcatSkillMLP"
        check_positive(
            name, in_features=in_features, out_features=out_features, num_skills=num_skills
        )
        self.in_features = int(in_features)
        self.out_features = int(out_features)
        self.num_skills = int(num_skills)
        width = self.in_features + self.num_skills
        self.trunk = shared_layers(name, width, hidden, activation)
        self.last = nn.Linear((width, *hidden)[-1], out_features)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Returns the outputs of each element's own skill, ``[*B, O]``; see the class."""
        return self.run(own_weights(self.trunk, self.last), *inputs)

    def run(self, weights: Sequence[Tensor], *inputs: Tensor) -> Tensor:
        """Does what ``forward`` does, with weights in place of the network's own.

        They are in the order of ``parameters()``; of N copies, stacked.
        """
        *features, skill = inputs
        check_skill(skill, features[0])
        x = torch.cat((*features, self._one_hot(skill, features[0])), -1)
        return run_layers(self.trunk._modules.values(), weights, x)

    def all_skills(self, *features: Tensor) -> Tensor:
        """Returns the outputs for every skill, ``[*B, Z, O]``."""
        x = torch.cat(features, -1).unsqueeze(-2)
        x = x.expand(*x.shape[:-2], self.num_skills, -1)
        skill = torch.arange(self.num_skills, device=x.device)
        one_hot = self._one_hot(skill, x).expand(*x.shape[:-1], -1)
        weights = own_weights(self.trunk, self.last)
        return run_layers(self.trunk, weights, torch.cat((x, one_hot), -1))

    def _one_hot(self, skill: Tensor, like: Tensor) -> Tensor:
        skills = torch.arange(self.num_skills, device=like.device)
        return (skill.unsqueeze(-1) == skills).to(like.dtype)

    @property
    def stackable(self) -> bool:
        """Whether the parameters of N copies may be put in stacked, to run all copies at once."""
        return can_stack(self.trunk)

    def extra_repr(self) -> str:
        """Returns the sizes that ``print`` shows."""
        return f"num_skills={self.num_skills}, out_features={self.out_features}"


class FeatureMLP(nn.Sequential):
    """A multi-layer perceptron that concatenates its inputs first; its layers are its items.

    Args:
        owner (str): who builds it, for errors.
        sizes (sequence of int): of input, hidden layers and output.
        activation (callable): builds the activation after each hidden layer. Default
            ``torch.nn.ReLU``.
        linear (callable): builds a linear layer from its two sizes. Default ``torch.nn.Linear``.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.modules.skill_mlp import FeatureMLP
        >>> FeatureMLP("Example", [3, 8, 4])(torch.zeros(5, 2), torch.zeros(5, 1)).shape
        torch.Size([5, 4])
    """

    def __init__(
        self,
        owner: str,
        sizes: Sequence[int],
        activation: Callable[[], nn.Module] = nn.ReLU,
        linear: Callable[[int, int], nn.Module] = nn.Linear,
    ) -> None:
        hidden = shared_layers(owner, sizes[0], sizes[1:-1], activation, linear)
        super().__init__(*hidden, linear(sizes[-2], sizes[-1]))

    def forward(self, *features: Tensor) -> Tensor:
        x = _concatenate(features)
        check_features(x, next(self.parameters()))
        return super().forward(x)

    def run(self, weights: Sequence[Tensor], *features: Tensor) -> Tensor:
        """Does what ``forward`` does, with weights in place of its own, as :meth:`SkillMLP.run`."""
        return run_layers(list(self)[:-1], weights, _concatenate(features))

    @property
    def stackable(self) -> bool:
        """Whether :meth:`run` can be used: only plain linear layers have parameters."""
        return can_stack(self)


def _concatenate(features: Sequence[Tensor]) -> Tensor:
    return features[0] if len(features) == 1 else torch.cat(tuple(features), -1)


def run_layers(hidden: Iterable[nn.Module], weights: Sequence[Tensor], x: Tensor) -> Tensor:
    """Runs x ``[*B, F]`` through hidden layers and a last one; of N stacked copies, ``[N, *B, O]``.

    Layers are applied here, not called as modules: their weights may be stacked, and calling a
    small module costs as much as what it computes.
    """
    check_features(x, weights[0])
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


def check_features(x: Tensor, weight: Tensor) -> None:
    """Raises ValueError unless features ``[*B, F]`` fit the weights of a first layer ``[O, F]``."""
    if x.shape[-1] != weight.shape[-1] or x.dtype != weight.dtype:
        fix = f"Build it with in_features={x.shape[-1]}, or give it other in_keys."
        if x.shape[-1] == weight.shape[-1]:
            fix = "Append DoubleToFloat() to the env, or change the network by network.to(dtype)."
        raise ValueError(
            f"A network for {weight.shape[-1]} features of {weight.dtype} was given "
            f"{x.shape[-1]} of {x.dtype}, the entries of its in_keys side by side. {fix}"
        )


def check_skill(skill: Tensor, features: Tensor) -> None:
    """Raises ValueError unless skills are int64 ``[*B]`` for features ``[*B, f]``."""
    if skill.dtype not in (torch.int64, torch.int32) or skill.shape != features.shape[:-1]:
        raise ValueError(
            f"Skills must be indices, int64 {list(features.shape[:-1])} for features "
            f"{list(features.shape)}; got {skill.dtype} {list(skill.shape)}. One-hot skills become "
            f"indices by skill.long().argmax(-1)."
        )


def own_weights(hidden: nn.Sequential, last: nn.Linear) -> list[Tensor]:
    """Returns the weights and biases that :func:`run_layers` takes."""
    layers = [layer for layer in hidden._modules.values() if type(layer) is nn.Linear]
    return [tensor for layer in (*layers, last) for tensor in (layer.weight, layer.bias)]


def can_stack(layers: Iterable[nn.Module]) -> bool:
    """Returns whether stacked parameters can be run: none but linear layers may have any."""
    others = [layer for layer in layers if type(layer) is not nn.Linear]
    # Not by their state dicts, which torch.compile cannot trace.
    return not any(True for layer in others for _ in (*layer.parameters(), *layer.buffers()))


def _linear(weight: Tensor, bias: Tensor, x: Tensor) -> Tensor:
    """Applies a linear layer, or N stacked ones (weight ``[N, O, I]``) to x ``[N, b, I]``."""
    if weight.ndim == 2:
        return F.linear(x, weight, bias)
    return torch.baddbmm(bias.unsqueeze(-2), x, weight.transpose(-2, -1))


class SkillNetwork(TensorDictModuleBase):
    """Runs a network on entries of a tensordict: reads the keys, calls it, writes one key.

    ``tensordict.nn.TensorDictModule`` does the same for any signature and costs about 200 us a
    call; this one has a fixed signature and costs what its network costs.

    Args:
        network (nn.Module): called with the entries of ``in_keys`` in order.
        in_keys (sequence of NestedKey): entries to read.
        out_key (NestedKey): entry to write.

    Reference:
        This project's; the interface is that of ``tensordict.nn.TensorDictModule``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillMLP, SkillNetwork
        >>> net = SkillNetwork(SkillMLP(2, 3, num_skills=4), ["velocity", "skill"], "logits")
        >>> td = TensorDict(velocity=torch.zeros(6, 2), skill=torch.zeros(6, dtype=torch.int64),
        ...                 batch_size=[6])
        >>> net(td)["logits"].shape
        torch.Size([6, 3])
    """

    network: nn.Module

    def __init__(
        self, network: nn.Module, in_keys: Sequence[NestedKey], out_key: NestedKey
    ) -> None:
        super().__init__()
        self.in_keys = key_list(type(self).__name__, in_keys)
        self.out_keys = [unravel_key(out_key)]
        self.out_key = self.out_keys[0]
        self.network = network

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the network's output under ``out_key``, of the shape the network gives."""
        inputs = entries(self, tensordict, self.in_keys)
        return tensordict.set(self.out_key, self.network(*inputs))


def shared_layers(
    owner: str,
    in_features: int,
    hidden: Sequence[int],
    activation: Callable[[], nn.Module],
    linear: Callable[[int, int], nn.Module] = nn.Linear,
) -> nn.Sequential:
    """Builds the hidden layers of a network, each a linear map and an activation."""
    hidden = tuple(hidden)
    if any(width < 1 for width in hidden):
        raise ValueError(
            f"{owner} needs hidden layers of positive width; got hidden={hidden}. "
            "Pass e.g. hidden=(64, 64)."
        )
    layers: list[nn.Module] = []
    for fan_in, fan_out in zip((in_features, *hidden), hidden, strict=False):
        layers += [linear(fan_in, fan_out), activation()]
    return nn.Sequential(*layers)


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


def check_positive(owner: str, **sizes: int) -> None:
    """Raises ValueError naming the first size that is not a positive int."""
    for name, size in sizes.items():
        if isinstance(size, bool) or not isinstance(size, int) or size < 1:
            raise ValueError(
                f"{owner} needs {name} to be a positive int, the size of a layer; got {size!r}."
            )


def key_list(owner: str, keys: Sequence[NestedKey] | NestedKey) -> list[NestedKey]:
    """Returns the keys as a list of unravelled keys; a lone string is one key."""
    listed = [keys] if isinstance(keys, str) else list(keys)
    if not listed:
        raise ValueError(
            f"{owner} needs at least one in_key to read its features from; got none. "
            "Pass e.g. in_keys=['velocity']."
        )
    return [unravel_key(key) for key in listed]
