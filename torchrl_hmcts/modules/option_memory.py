"""A memory of what options really led to, against a model that errs there.

Letters: *B batch of the tensordict, m rows, C contexts, N outcomes kept of each, D predicted state
numbers, f numbers compared.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.checks import real_number
from torchrl_hmcts.modules.option_model import OptionModel
from torchrl_hmcts.modules.skill_mlp import check_sizes, key_list


class OptionMemory:
    r"""Replaces a prediction by an observed outcome of the same option from nearly the same state.

    With :math:`\phi` the entries ``keys`` side by side and :math:`(s_i, o_i)` the options executed
    in the same context, a prediction for :math:`(s, o)` gives way to outcome :math:`i` if

    .. math:: o_i = o, \qquad i = \arg\min_j \lVert \phi(s) - \phi(s_j) \rVert, \qquad
        \lVert \phi(s) - \phi(s_i) \rVert \le r

    A plan that failed because the model erred is else made again and again from the same state.
    State entries change by what they changed then.

    Args:
        model (OptionModel): whose predictions are replaced.
        keys (sequence of NestedKey): entries that are compared, those on which an outcome depends.
        radius (float): r, in units of the entries.
        num_contexts (int): C, e.g. the number of mazes.
        context_key (NestedKey): index of the context, int64 ``[*B]``, e.g. ``"maze_index"``.
        option_key (NestedKey): int64 ``[*B]``. Default ``"option"``.
        capacity (int): N; the oldest outcome makes room. Default 64.

    Raises:
        ValueError: if a number is not positive.

    Reference:
        Outcomes kept as they were, for cases that return: Lengyel and Dayan, "Hippocampal
        Contributions to Control: The Third Way", 2007.

    Examples:
        >>> from torchrl_hmcts.modules import OptionMemory, OptionModel, SkillMLP
        >>> model = OptionModel(lambda n: SkillMLP(1, n, num_skills=2), ["place", "option"],
        ...                     {"place": 1}, max_duration=9)
        >>> memory = OptionMemory(model, ["place"], 0.1, num_contexts=1, context_key="maze")
        >>> td = TensorDict(place=torch.zeros(1, 1), option=torch.tensor([1]),
        ...                 maze=torch.tensor([0]), batch_size=[1])
        >>> after = TensorDict(place=torch.ones(1, 1), reward=torch.zeros(1, 1),
        ...                    duration=torch.full((1, 1), 9),
        ...                    terminated=torch.zeros(1, 1, dtype=torch.bool), batch_size=[1])
        >>> memory.remember(td.clone().set("next", after))
        >>> memory.recall(td, model.predict(td))["place"].tolist()
        [[1.0]]
    """

    def __init__(
        self,
        model: OptionModel,
        keys: Sequence[NestedKey],
        radius: float,
        *,
        num_contexts: int,
        context_key: NestedKey,
        option_key: NestedKey = "option",
        capacity: int = 64,
    ) -> None:
        check_sizes("OptionMemory", num_contexts=num_contexts, capacity=capacity)
        self.model = model
        self.keys = key_list("OptionMemory", keys)
        self.radius = real_number("OptionMemory", "radius", radius, above=0.0)
        self.context_key = unravel_key(context_key)
        self.option_key = unravel_key(option_key)
        self.in_keys = [*self.keys, self.context_key, self.option_key]
        self.capacity = capacity
        self.num_contexts = num_contexts
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._count = torch.zeros(self.num_contexts, dtype=torch.int64)
        self._option = torch.full((self.num_contexts, self.capacity), -1)
        self._place: Tensor | None = None  # [C, N, f]
        self._outcome: Tensor | None = None  # [C, N, D + 3]

    def remember(self, tensordict: TensorDictBase) -> None:
        """Keep the outcomes of transitions ``[*B]``; padding (``"_step"`` False) is left out."""
        td = tensordict.reshape(-1)
        stepped = td.get("_step", None)
        if stepped is not None:
            td = td[stepped.reshape(-1)]
        if not len(td):
            return
        place, outcome = self._places(td), self.model.targets(td, normalized=False)
        if self._place is None or self._outcome is None:
            shape = (self.num_contexts, self.capacity)
            self._option = self._option.to(place.device)
            self._place = place.new_zeros(*shape, place.shape[-1])
            self._outcome = outcome.new_zeros(*shape, outcome.shape[-1])
        options = td.get(self.option_key)
        for row, context in enumerate(td.get(self.context_key).tolist()):
            slot = int(self._count[context]) % self.capacity
            self._option[context, slot] = options[row]
            self._place[context, slot] = place[row]
            self._outcome[context, slot] = outcome[row]
            self._count[context] += 1

    def recall(self, tensordict: TensorDictBase, predicted: TensorDict) -> TensorDict:
        """Return predictions ``[*B]``, replaced where an outcome is remembered."""
        if self._place is None or self._outcome is None:
            return predicted
        td = tensordict.reshape(-1)
        context = td.get(self.context_key)
        distance = (self._place[context] - self._places(td).unsqueeze(1)).norm(dim=-1)  # [m, N]
        other = self._option[context] != td.get(self.option_key).unsqueeze(-1)
        nearest, slot = distance.masked_fill(other, torch.inf).min(-1)
        known = nearest <= self.radius
        if not known.any():
            return predicted
        outcome = self._outcome[context[known], slot[known]]
        replaced: TensorDict = predicted.reshape(-1).clone()
        model, (reward, duration, ended) = self.model, outcome[:, -3:].split(1, -1)
        known_values = {
            **model.changed(td[known], outcome[:, :-3]),
            model.reward_key: reward,
            model.duration_key: duration,
            model.probability_key: ended,
            model.terminated_key: ended > 0.5,
            model.disagreement_key: torch.zeros_like(ended),
        }
        for key, value in known_values.items():
            entry = replaced.get(key)
            entry[known] = value.to(entry.dtype)
        return replaced.reshape(predicted.batch_size)

    def _places(self, td: TensorDictBase) -> Tensor:
        return torch.cat([td.get(key).reshape(len(td), -1).float() for key in self.keys], -1)
