"""Weights of a prioritised replay buffer, under any key."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

_Base: Any = torch.nn.Module if TYPE_CHECKING else object


class PriorityWeights(_Base):
    """Lets the key ``priority_weight`` of a loss be nested, which TorchRL's lookup refuses."""

    def _maybe_get_priority_weight(self, tensordict: TensorDictBase) -> Tensor | None:
        if self.use_prioritized_weights not in (True, "auto"):
            return None
        return tensordict.get(self.tensor_keys.priority_weight, None)
