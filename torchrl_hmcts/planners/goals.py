"""Plans of a manager as sequences of goals for a worker.

Letters: m states to plan from, L goals of the longest plan, D coordinates of a goal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from torchrl_hmcts.planners.mcts import MCTSPlanner


class GoalPlanner:
    r"""Searches a macro environment and returns the states along the best plan as goals.

    .. math:: G = g_0, g_1, \dots, g_n, \qquad g_i = \phi(s_{i + 1})

    with :math:`s_0` the state planned from, :math:`s_1, \dots, s_{n + 1}` the states the plan's
    options lead to and :math:`\phi` the entry ``goal_key``. The state planned from is no goal.

    Args:
        planner (MCTSPlanner): the manager, over the macro environment.
        to_macro (callable): ``to_macro(td [m]) -> td [m]``, the macro environment's state for a
            state of the worker's environment.
        goal_key (NestedKey): entry ``[m, D]`` or ``[m]`` of the macro environment's state or
            observation that is the goal. Default ``"position"``.
        in_keys (sequence of NestedKey, optional): entries that ``to_macro`` reads. Default: all.

    Raises:
        ValueError: if the macro environment has no entry ``goal_key``; when planning, if a search
            ends without a plan.

    Reference:
        Dissertation, section 3.2.1 and figure 3.3.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.planners import GoalPlanner, MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> chain = ChainEnv(length=5)
        >>> def to_macro(td):  # the worker's position is a real number, the chain's an integer
        ...     return TensorDict({"state": td["x"].round().long()}, td.batch_size)
        >>> manager = GoalPlanner(MCTSPlanner(chain), to_macro, goal_key="state")
        >>> goals, lengths = manager.plan_goals(TensorDict({"x": torch.tensor([1.8])}, [1]))
        >>> goals.tolist(), lengths.tolist()
        ([[[3], [4]]], [2])
    """

    def __init__(
        self,
        planner: MCTSPlanner,
        to_macro: Callable[[TensorDictBase], TensorDictBase],
        *,
        goal_key: NestedKey = "position",
        in_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        self.planner = planner
        self.to_macro = to_macro
        self.goal_key = unravel_key(goal_key)
        planner.simulator.keep([self.goal_key])
        if in_keys is not None:
            self.in_keys = [unravel_key(key) for key in in_keys]

    def plan_goals(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Plan from states.

        Args:
            tensordict (TensorDictBase): states of the worker's environment, batch ``[m]``.

        Returns:
            the goals ``[m, L, D]``, the last one repeated, and the lengths, int64 ``[m]``.
        """
        macro = self.to_macro(tensordict)
        plan = self.planner.plan(macro)
        if not plan.found.all():
            bad = int((~plan.found).nonzero()[0])
            state = {key: macro.get(key)[bad].tolist() for key in self.planner.simulator.root_keys}
            raise ValueError(
                f"The search found no plan from {state} within {self.planner.budget}. Allow it "
                f"more expansions, or check that the target can be reached."
            )
        goals = plan.states.get(self.goal_key)[:, 1:]
        goals = goals.unsqueeze(-1) if goals.ndim == 2 else goals.flatten(2)
        return goals, plan.lengths

    def __repr__(self) -> str:
        return f"GoalPlanner({self.planner}, goal_key={self.goal_key!r})"
