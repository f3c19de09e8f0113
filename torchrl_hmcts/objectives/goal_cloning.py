"""Learning from recorded episodes to reach places that lie ahead in them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.checks import real_number
from torchrl_hmcts.objectives.loss import Loss, run_module

_MOST = 3.0  # standard deviations of progress that count


class GoalCloningLoss(Loss):
    r"""Clones recorded actions that led to a goal; actions that led there fast weigh more.

    .. math::

        L = w\, \lVert \pi_\theta(s, g) - a \rVert^2, \qquad
        w \propto \exp(\beta A), \qquad
        A = \frac{p - \bar p}{\sigma_p}, \quad p = \lVert x - g \rVert - \lVert x' - g \rVert

    with the places x and x' before and after the action a and the goal g, a place that was reached
    later in the episode. The weights have mean 1 in a batch; A is cut at 3 both ways.
    :math:`\beta = 0` is plain cloning.

    Args:
        actor_network (TensorDictModuleBase): reads its ``in_keys``, the goal among them, and writes
            ``action``, without a draw.
        progress_coeff (float): :math:`\beta`, not negative.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Returns:
        TensorDict with ``loss_actor`` and the detached ``action_error`` (mean absolute, without
        weights). With ``reduction="none"`` both are ``[*B]``.

    Raises:
        ValueError: if ``progress_coeff`` is negative.

    Keys (``set_keys``): ``action`` (float ``[*B, D]``), ``position`` (float ``[*B, F]``, read
    before the step and from ``"next"``), ``goal`` (float ``[*B, F]``), ``priority_weight``; each by
    its own name by default.

    Reference:
        Peng et al., "Advantage-weighted regression", 2019, arXiv 1910.00177; goals in hindsight:
        Ghosh et al., "Learning to reach goals via iterated supervised learning", 2019,
        arXiv 1912.06088.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.objectives import GoalCloningLoss
        >>> still = TensorDictModule(lambda goal: 0.0 * goal, ["goal"], ["action"])
        >>> td = TensorDict(position=torch.zeros(2, 1), goal=torch.ones(2, 1), batch_size=[2],
        ...                 action=torch.tensor([[1.0], [-1.0]]),
        ...                 next=TensorDict(position=torch.tensor([[0.1], [-0.1]]), batch_size=[2]))
        >>> GoalCloningLoss(still, progress_coeff=0.0)(td)["loss_actor"].item()
        1.0
    """

    @dataclass
    class _AcceptedKeys(Loss._AcceptedKeys):
        action: NestedKey = "action"
        position: NestedKey = "position"
        goal: NestedKey = "goal"

    out_keys = ["loss_actor", "action_error"]

    actor_network: TensorDictModuleBase
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    progress_coeff: Tensor

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        *,
        progress_coeff: float = 2.0,
        reduction: str = "mean",
    ) -> None:
        super().__init__(reduction)
        coeff = real_number("GoalCloningLoss", "progress_coeff", progress_coeff, least=0.0)
        self.convert_to_functional(actor_network, "actor_network", create_target_params=False)
        self.register_coeff_buffer("progress_coeff", coeff)

    def _reads(self) -> Iterable[NestedKey]:
        keys = self.tensor_keys
        after = ("next", *((keys.position,) if isinstance(keys.position, str) else keys.position))
        return [*self.actor_network.in_keys, keys.action, keys.position, after, keys.goal]

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        keys = self.tensor_keys
        chosen = run_module(self.actor_network, self.actor_network_params, tensordict)
        error = chosen.get(keys.action) - tensordict.get(keys.action)
        goal, place = tensordict.get(keys.goal), tensordict.get(keys.position)
        after = tensordict.get("next").get(keys.position)
        progress = (place - goal).norm(dim=-1) - (after - goal).norm(dim=-1)
        spread = progress.std(correction=0).clamp_min(1e-8)
        advantage = ((progress - progress.mean()) / spread).clamp(-_MOST, _MOST)
        weight = (self.progress_coeff * advantage).exp()
        weight = weight / weight.mean()
        return {
            "loss_actor": self._reduce(weight * error.square().sum(-1), tensordict),
            "action_error": self._average(error.abs().mean(-1)),
        }
