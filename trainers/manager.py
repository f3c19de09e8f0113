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
    """

    def __init__(
        self,
        mean: Tensor,
        std: Tensor,
        num_options: int,
        *,
        bounded: bool = True,
    ) -> None:
        super().__init__()
        self.num_options, self.bounded = num_options, bounded
        self.mean: Tensor
        self.std: Tensor
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float().clamp_min(1e-6))
        self.mlp = MLP(len(mean), num_options + 1, num_cells=[128, 128])

    def forward(self, *entries: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits ``[*B, A]`` and values ``[*B, 1]``."""
        flat = torch.cat([entry.float() for entry in entries], -1)
        out: Tensor = self.mlp((flat - self.mean) / self.std)
        value = out[..., self.num_options :]
        return out[..., : self.num_options], value.sigmoid() if self.bounded else value


def make_manager(
    planner: MCTSPlanner, keys: Sequence[NestedKey], *, bounded: bool
) -> TensorDictModule:
    """Build a manager network for a planner's states, of the entries ``keys``."""
    planner.simulator.keep(list(keys))
    spec = planner.simulator.env.full_observation_spec_unbatched
    size = sum(spec[key].shape.numel() for key in keys)
    net = ManagerNet(torch.zeros(size), torch.ones(size), planner.num_options, bounded=bounded)
    return TensorDictModule(net, list(keys), ["logits", "state_value"])


def scale_by(network: TensorDictModule, planner: MCTSPlanner, starts: TensorDictBase) -> None:
    """Scale a manager network by the states that searches meet."""
    tree = planner.search(starts).tree
    assert tree.states is not None
    states = tree.states[torch.arange(tree.capacity) < torch.from_numpy(tree.num_nodes)[:, None]]
    parts = [states[key].float().reshape(len(states), -1) for key in network.in_keys]
    seen = torch.cat(parts, -1)
    network.module.mean.copy_(seen.mean(0))
    network.module.std.copy_(seen.std(0).clamp_min(1e-6))


class ManagerPolicy(TensorDictModuleBase):
    """Takes the option of the highest logit, without a search."""

    def __init__(self, network: TensorDictModuleBase) -> None:
        super().__init__()
        self.network = network
        self.in_keys, self.out_keys = list(network.in_keys), ["option"]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the option of each row."""
        logits = self.network(tensordict.select(*self.in_keys))["logits"]
        mask: Any = tensordict.get("action_mask", None)
        if mask is not None:
            logits = logits.masked_fill(~mask, -torch.inf)
        return tensordict.set("option", logits.argmax(-1))
