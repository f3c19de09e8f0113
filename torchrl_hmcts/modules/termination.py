"""Conditions under which options end, for :class:`~torchrl_hmcts.transforms.OptionTransform`.

Each is a callable ``termination(td) -> bool [*B]``; ``td`` holds the entries after a base step, the
option, and under ``"duration"`` the base steps it has taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.modules.skill_actor import is_to_sample
from torchrl_hmcts.modules.skill_mlp import SkillMLP, SkillNetwork, key_list


class StallTermination:
    r"""Ends an option in which nothing has changed for some base steps; a call gives bool ``[*B]``.

    .. math:: \text{ends} \iff \min(n, k) \ge N

    with :math:`n` the count of a :class:`~torchrl_hmcts.transforms.StallTransform` and :math:`k`
    the base steps of the option: what stood still before it began does not count.

    Args:
        num_steps (int): base steps :math:`N` in a row without a change, at least 1.
        stalled_key (NestedKey): the count, int64 ``[*B, 1]``. Default ``"stalled_steps"``.
        duration_key (NestedKey): base steps taken, int64 ``[*B, 1]``. Default ``"duration"``.

    Raises:
        ValueError: if ``num_steps`` is below 1; when an ``OptionTransform`` is attached to an env
            that writes no such count.

    Reference:
        This project's; options that end in states: Sutton, Precup and Singh, "Between MDPs and
        semi-MDPs", 1999.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import StallTermination
        >>> td = TensorDict(stalled_steps=torch.tensor([[1], [3], [3]]),
        ...                 duration=torch.tensor([[9], [9], [2]]), batch_size=[3])
        >>> StallTermination(3)(td)
        tensor([False,  True, False])
    """

    def __init__(
        self,
        num_steps: int,
        stalled_key: NestedKey = "stalled_steps",
        duration_key: NestedKey = "duration",
    ) -> None:
        self.num_steps = whole_number("StallTermination", "num_steps", num_steps, least=1)
        self.stalled_key = unravel_key(stalled_key)
        self.duration_key = unravel_key(duration_key)
        self.in_keys: list[NestedKey] = [self.stalled_key, self.duration_key]

    def __call__(self, td: TensorDictBase) -> Tensor:
        count = torch.minimum(td.get(self.stalled_key), td.get(self.duration_key))
        return (count >= self.num_steps).reshape(td.batch_size)

    def __repr__(self) -> str:
        return f"StallTermination({self.num_steps})"


class TerminationNetwork(SkillNetwork):
    r"""Logits of :math:`\beta(s, o)`, the probability that option o ends in state s.

    .. math:: \beta(s, o) = \mathrm{sigmoid}(\mathrm{SkillMLP}(s, o))

    Shared layers and one head per option.

    Args:
        in_features (int): summed sizes of the entries ``in_keys``.
        num_options (int): number of options.
        in_keys, skill_key, hidden, activation: as :class:`SkillActor`'s.
        termination_logits_key (NestedKey): entry written, ``[*B, 1]``.
        initial_probability (float): where :math:`\beta` begins, about, 0.001 to 0.999. Default 0.5.

    Raises:
        ValueError: if a size is not positive or the probability is out of its range.

    Reference:
        Bacon, Harb and Precup, "The option-critic architecture", 2017, arXiv 1609.05140.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import TerminationNetwork
        >>> network = TerminationNetwork(2, num_options=4, in_keys=["velocity"])
        >>> td = TensorDict(velocity=torch.randn(5, 2), skill=torch.zeros(5).long(), batch_size=[5])
        >>> network(td)["termination_logits"].shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        in_features: int,
        num_options: int,
        *,
        in_keys: Sequence[NestedKey],
        skill_key: NestedKey = "skill",
        termination_logits_key: NestedKey = "termination_logits",
        initial_probability: float = 0.5,
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
    ) -> None:
        beta = real_number(
            "TerminationNetwork",
            "initial_probability",
            initial_probability,
            least=0.001,
            most=0.999,
        )
        network = SkillMLP(in_features, 1, num_options, hidden, activation)
        nn.init.constant_(network.heads.bias, math.log(beta / (1.0 - beta)))
        keys = [*key_list("TerminationNetwork", in_keys), skill_key]
        super().__init__(network, keys, termination_logits_key)
        self.num_options = num_options
        self.skill_key = unravel_key(skill_key)


class LearnedTermination:
    r"""Ends an option with a network's probability, or where that is at least one half.

    A call gives bool ``[*B]``.

    .. math:: \text{ends} \sim \mathrm{Bernoulli}(\beta(s, o)), \qquad
        \text{or, deterministic,} \quad \text{ends} \iff \beta(s, o) \ge 1/2

    Deterministic is the choice for planning: a plan is executed as it was simulated. The network
    is called as it is, without gradients, and never becomes part of an env.

    Args:
        network (TensorDictModuleBase): writes logits ``[*B, 1]``, e.g. a
            :class:`TerminationNetwork`, or a ``TensorDictSequential`` of what computes its
            features and one.
        deterministic (bool): do not sample, as :class:`SkillPolicy`. Default ``True``.
        generator (torch.Generator, optional): as :class:`SkillPolicy`'s.
        every (int): base steps between two questions, so that an option may end after that many,
            twice that many and so on; asking costs a call of the network. Default 1.
        termination_logits_key (NestedKey): Default ``"termination_logits"``.
        duration_key (NestedKey): base steps taken, int64 ``[*B, 1]``. Default ``"duration"``.

    Raises:
        ValueError: if ``every`` is below 1, or the network does not write the logits.

    Reference:
        Bacon, Harb and Precup, "The option-critic architecture", 2017, arXiv 1609.05140.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import LearnedTermination, TerminationNetwork
        >>> network = TerminationNetwork(2, num_options=4, in_keys=["velocity"])
        >>> termination = LearnedTermination(network, every=5)
        >>> td = TensorDict(velocity=torch.randn(3, 2), skill=torch.zeros(3, dtype=torch.int64),
        ...                 duration=torch.full((3, 1), 4), batch_size=[3])
        >>> termination(td)
        tensor([False, False, False])
    """

    def __init__(
        self,
        network: TensorDictModuleBase,
        *,
        deterministic: bool = True,
        generator: torch.Generator | None = None,
        every: int = 1,
        termination_logits_key: NestedKey = "termination_logits",
        duration_key: NestedKey = "duration",
    ) -> None:
        self.every = whole_number("LearnedTermination", "every", every, least=1)
        self.termination_logits_key = unravel_key(termination_logits_key)
        written = [unravel_key(key) for key in getattr(network, "out_keys", ())]
        if self.termination_logits_key not in written:
            raise ValueError(
                f"LearnedTermination reads {self.termination_logits_key!r}, which "
                f"{type(network).__name__} does not write; it writes {written}. Pass the "
                f"network's own key as termination_logits_key."
            )
        self.network = network
        self.deterministic = bool(deterministic)
        self.generator = generator
        self.duration_key = unravel_key(duration_key)
        keys = [unravel_key(key) for key in network.in_keys]
        self.in_keys: list[NestedKey] = list(dict.fromkeys([*keys, self.duration_key]))

    @torch.no_grad()
    def probability(self, td: TensorDictBase) -> Tensor:
        """Returns the probability that the option ends here, ``[*B]``, with any ``every``."""
        logits = self.network(td.copy()).get(self.termination_logits_key)
        return logits.sigmoid().reshape(td.batch_size)

    def __call__(self, td: TensorDictBase) -> Tensor:
        asked: Tensor | None = None
        if self.every > 1:
            asked = (td.get(self.duration_key) % self.every == 0).reshape(td.batch_size)
            if not asked.any():
                return asked
        probability = self.probability(td)
        if not is_to_sample(self.deterministic):
            ends = probability >= 0.5
        else:
            draw = torch.empty_like(probability).uniform_(generator=self.generator)
            ends = draw < probability
        return ends if asked is None else ends & asked

    def __repr__(self) -> str:
        how = "deterministic" if self.deterministic else "sampled"
        return f"LearnedTermination({type(self.network).__name__}, {how}, every={self.every})"
