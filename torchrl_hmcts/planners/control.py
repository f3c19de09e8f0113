"""Carrying plans out: a policy over options that plans, follows its plan and plans again.

Letters: *B batch of the tensordict, L ``max_plan_length``.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_hmcts.planners.mcts import MCTSPlanner


class HierarchicalPolicy(TensorDictModuleBase):
    """Follows a planner's plan option by option, and plans again when it has come to its end.

    The plan lives in the tensordict, as a recurrent policy's state does: ``"plan"`` (int64
    ``[*B, L]``), ``"plan_length"`` and ``"plan_step"`` (int64 ``[*B, 1]``). An element without a
    plan, or at the end of it, is planned for; where no plan is found, the planner's choice is
    taken and planning starts anew after it.

    Where episodes follow each other in one rollout (auto-reset, collectors), append TorchRL's
    ``InitTracker`` to the env: by its ``"is_init"`` the policy knows that a plan is out of date.

    Args:
        planner (MCTSPlanner): the manager.
        max_plan_length (int): options of a plan that are kept, L. Default 64.

    Raises:
        ValueError: if ``max_plan_length`` is below 1.

    Reference:
        Dissertation, sections 3.2.1 and 4.2: the worker carries the manager's plan out.

    Example:
        >>> from torchrl_hmcts.planners import HierarchicalPolicy, MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> policy = HierarchicalPolicy(MCTSPlanner(env))
        >>> env.rollout(10, policy=policy)["plan_step"].flatten().tolist()
        [1, 2, 3]
    """

    def __init__(self, planner: MCTSPlanner, *, max_plan_length: int = 64) -> None:
        super().__init__()
        if max_plan_length < 1:
            raise ValueError(
                f"HierarchicalPolicy needs max_plan_length >= 1; got {max_plan_length}."
            )
        self.planner = planner
        self.max_plan_length = max_plan_length
        self.in_keys = list(planner.in_keys)
        self.out_keys = [planner.option_key, "plan", "plan_length", "plan_step"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = tensordict.batch_size
        plan = tensordict.get("plan", None)
        if plan is None:
            empty = torch.zeros((*shape, 1), dtype=torch.int64, device=tensordict.device)
            plan = empty.expand(*shape, self.max_plan_length).clone()
            length, step = empty, empty.clone()
        else:
            plan = plan.clone()
            length, step = (tensordict.get(k).clone() for k in ("plan_length", "plan_step"))
        needs = (step >= length).squeeze(-1)
        is_init, done, stepped = (tensordict.get(k, None) for k in ("is_init", "done", "_step"))
        if is_init is not None:
            needs = needs | is_init.reshape(shape)
        if done is not None:
            needs = needs & ~done.reshape(shape)
        if stepped is not None:  # False where a rollout goes on without the element
            needs = needs & stepped.reshape(shape)
        if needs.any():
            step[needs] = 0
            plan[needs], length[needs] = self._plan(tensordict[needs])
        option = plan.gather(-1, step.clamp_max(self.max_plan_length - 1)).squeeze(-1)
        tensordict.set(self.planner.option_key, self.planner.simulator.encode(option))
        tensordict.set("plan", plan)
        tensordict.set("plan_length", length)
        tensordict.set("plan_step", step + 1)
        return tensordict

    def _plan(self, td: TensorDictBase) -> tuple[Tensor, Tensor]:
        found = self.planner.plan(td)
        search = self.planner.last_search
        assert search is not None
        width = min(found.options.shape[-1], self.max_plan_length)
        plan = torch.zeros((len(found), self.max_plan_length), dtype=torch.int64)
        plan[:, :width] = found.options[:, :width].clamp_min(0)
        fallback = torch.from_numpy(self.planner._choose(search))
        plan[~found.found, 0] = fallback[~found.found]
        length = torch.where(found.found, found.lengths.clamp_max(self.max_plan_length), 1)
        return plan, length.unsqueeze(-1)
