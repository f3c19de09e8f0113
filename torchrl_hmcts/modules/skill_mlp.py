"""A multi-layer perceptron with shared layers and one output head per skill."""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
        *features, skill = inputs
        x = features[0] if len(features) == 1 else torch.cat(features, -1)
        num_nets = self.heads.weight.shape[:-2]  # () or, stacked, (N,)
        if num_nets:
            x = x.reshape(1, -1, x.shape[-1]).expand(*num_nets, -1, -1)
        # Layers are applied here, not called as modules: their parameters may be stacked, and
        # calling a small module costs as much as what it computes.
        for layer in self.trunk._modules.values():
            if type(layer) is nn.Linear:
                x = _linear(layer, x)
            else:
                x = x.relu() if type(layer) is nn.ReLU else layer(x)
        y = _linear(self.heads, x)
        shape = (*num_nets, *skill.shape)
        y = y.view(*shape, self.num_skills, self.out_features)
        index = skill.unsqueeze(-1).unsqueeze(-1).expand(*shape, 1, self.out_features)
        return y.gather(-2, index).squeeze(-2)

    @property
    def stackable(self) -> bool:
        """Whether the parameters of N copies may be put in stacked, to run all copies at once."""
        layers = [layer for layer in self.trunk if type(layer) is not nn.Linear]
        return not any(True for layer in layers for _ in layer.state_dict())

    def extra_repr(self) -> str:
        return f"num_skills={self.num_skills}, out_features={self.out_features}"


def _linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """Applies a linear layer, or N stacked ones (weight ``[N, O, I]``) to x ``[N, b, I]``."""
    weight, bias = layer.weight, layer.bias
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
        inputs = [tensordict.get(key) for key in self.in_keys]
        return tensordict.set(self.out_key, self.network(*inputs))


def shared_layers(
    owner: str, in_features: int, hidden: Sequence[int], activation: Callable[[], nn.Module]
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
        layers += [nn.Linear(fan_in, fan_out), activation()]
    return nn.Sequential(*layers)


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
