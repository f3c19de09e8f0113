"""A network for the manager: which option to take, and what a state is worth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_hmcts.planners import MCTSPlanner


class ManagerNet(nn.Module):
    r"""Maps entries of a state to logits of options and a value.

    .. math:: l, v = f\bigl((x - \mu) / \sigma\bigr)

    Letters: F numbers of the entries side by side, A options.

    Args:
        mean, std: ``[F]``, of the states.
        num_options: A.
        bounded: whether values lie in (0, 1), as where there is one reward at the end.
        hidden: widths of the hidden layers.
    """

    def __init__(
        self,
        mean: Tensor,
        std: Tensor,
        num_options: int,
        *,
        bounded: bool = True,
        hidden: Sequence[int] = (128, 128),
    ) -> None:
        super().__init__()
        self.num_options, self.bounded = num_options, bounded
        self.mean: Tensor
        self.std: Tensor
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float().clamp_min(1e-6))
        self.mlp = MLP(len(mean), num_options + 1, num_cells=list(hidden))

    def forward(self, *entries: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits ``[*B, A]`` and values ``[*B, 1]``."""
        flat = torch.cat([entry.float() for entry in entries], -1)
        out: Tensor = self.mlp((flat - self.mean) / self.std)
        value = out[..., self.num_options :]
        return out[..., : self.num_options], value.sigmoid() if self.bounded else value


def make_manager(
    planner: MCTSPlanner, keys: Sequence[NestedKey], starts: TensorDictBase, *, bounded: bool
) -> TensorDictModule:
    """Build a manager network for a planner's states, scaled by those that searches meet.

    Args:
        planner: over the options.
        keys: entries of its states that the network reads, each ``[F_i]``.
        starts: to search from, ``[M]``.
        bounded: see :class:`ManagerNet`.

    Returns:
        A module that writes ``"logits"`` and ``"state_value"``.
    """
    planner.simulator.keep(list(keys))
    search = planner.search(starts)
    assert search.tree.states is not None
    used = torch.arange(search.tree.capacity) < torch.from_numpy(search.tree.num_nodes)[:, None]
    states = search.tree.states[:, : search.tree.capacity][used]
    seen = torch.cat([states[key].float().reshape(len(states), -1) for key in keys], -1)
    net = ManagerNet(seen.mean(0), seen.std(0), planner.num_options, bounded=bounded)
    return TensorDictModule(net, list(keys), ["logits", "state_value"])


class ManagerPolicy(TensorDictModuleBase):
    """Takes the option of the highest logit, without a search.

    Args:
        network: writes ``"logits"``.
        option_key: entry that the option is written to.
        mask_key: options that may be taken, where there is such an entry.
    """

    def __init__(
        self,
        network: TensorDictModuleBase,
        option_key: NestedKey = "option",
        mask_key: NestedKey = "action_mask",
    ) -> None:
        super().__init__()
        self.network, self.option_key, self.mask_key = network, option_key, mask_key
        self.in_keys, self.out_keys = list(network.in_keys), [option_key]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the option of each row."""
        logits = self.network(tensordict.select(*self.in_keys))["logits"]
        mask: Any = tensordict.get(self.mask_key, None)
        if mask is not None:
            logits = logits.masked_fill(~mask, -torch.inf)
        return tensordict.set(self.option_key, logits.argmax(-1))
