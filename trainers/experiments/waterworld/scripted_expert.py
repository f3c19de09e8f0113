"""A controller that steers from goal to goal: what a trained worker is measured by.

Letters: *B batch of the tensordict, K goals shown.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_hmcts.checks import real_number


class ScriptedExpert(TensorDictModuleBase):
    r"""Thrusts along the axis on which the velocity is furthest from the wanted one.

    With the goals :math:`g_0, g_1, g_2` relative to the disc and its velocity :math:`v`

    .. math::

        e = g_0 + w_1 (g_1 - g_0) + w_2 (g_2 - g_1) - k\,v, \qquad
        a = \text{thrust along } \operatorname*{arg\,max}_{x, y} |e|
        \text{ in the direction of its sign}

    On a straight line of goals the disc goes at its largest speed; before a corner :math:`w_1`
    turns the thrust into the next corridor, whose wall takes the old speed away. It knows neither
    walls nor maze: the manager's goals lead around them.

    Reads ``"goals"``, relative to the position, ``[*B, 2 K]``, and ``"velocity"``; writes
    ``"action"``, int64 ``[*B]``: 0 up, 1 down, 2 left, 3 right.

    Args:
        next_goal, second_goal, damping (float): :math:`w_1`, :math:`w_2` and :math:`k`, seconds.
            Default 0.4, 0.1 and 0.2, the best of 69 drawn at random, in 220 episodes in mazes of
            the training split; the number of base steps changes by 2 % around them.

    Example:
        >>> import torch
        >>> from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import make_goal_env
        >>> env = make_goal_env(seed=0)
        >>> data = env.rollout(1000, policy=ScriptedExpert())
        >>> data["next", "task_reward"].sum().item()
        1.0
    """

    in_keys, out_keys = ["goals", "velocity"], ["action"]

    def __init__(
        self, next_goal: float = 0.4, second_goal: float = 0.1, damping: float = 0.2
    ) -> None:
        super().__init__()
        numbers = {"next_goal": next_goal, "second_goal": second_goal, "damping": damping}
        weights = [real_number("ScriptedExpert", name, value) for name, value in numbers.items()]
        self.weights: Sequence[float] = (1.0, *weights[:2])
        self.damping = weights[2]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of each row, towards its goals."""
        goals = tensordict.get("goals").unflatten(-1, (-1, 2))  # [*B, K, 2]
        steps = torch.cat((goals[..., :1, :], goals.diff(dim=-2)), -2)[..., :3, :]
        weights = steps.new_tensor(self.weights[: steps.shape[-2]])
        error = (weights.unsqueeze(-1) * steps).sum(-2)
        error = error - self.damping * tensordict.get("velocity")
        axis = error.abs().argmax(-1, keepdim=True)  # 0 for x, 1 for y
        forwards = error.gather(-1, axis) > 0
        action = torch.where(axis == 0, 2, 0) + forwards.to(torch.int64)
        return tensordict.set("action", action.squeeze(-1))
