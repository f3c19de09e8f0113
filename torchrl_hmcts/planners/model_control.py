"""Acting in one env while planning in another: by its options, or by goals for a worker.

Letters: *B batch of the tensordict, m states, L goals of the longest plan, D coordinates of a goal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from torchrl_hmcts.checks import instance
from torchrl_hmcts.nesting import env_name
from torchrl_hmcts.planners.control import EpisodeStarts, HierarchicalPolicy
from torchrl_hmcts.planners.mcts import MCTSPlanner

StateMap = Callable[[TensorDictBase], TensorDictBase]


class ModelBasedControl(TensorDictModuleBase):
    r"""Acts in an env that cannot be set to a state, by planning in a model that can.

    Before every decision the model's state is made from what the real env shows,

    .. math:: \hat s = \mathrm{map}(o), \qquad \text{option} = \mathrm{plan}(\hat s),

    and the option is executed in the real env, which is under an
    :class:`~torchrl_hmcts.transforms.OptionTransform` with the same worker. The plan's first option
    ends somewhere else than the model predicted, so that by default a new plan is made after every
    option.

    Args:
        planner (MCTSPlanner): over the model, a macro env that can be set to any state.
        state_map (callable, optional): ``state_map(td) -> TensorDict [*B]`` of what the planner
            reads (its ``in_keys``), from the entries of the real env. Default: the real env writes
            them itself, and they are taken as they are.
        env (EnvBase, optional): the real macro env, checked once against the model's options.
        replan_every (int, optional): options after which to plan again. Default 1; None for the
            plan's end.
        max_plan_length (int): as of :class:`HierarchicalPolicy`. Default 64.

    Writes: the option, and the plan as :class:`HierarchicalPolicy` does.

    Raises:
        ValueError: if the real env has other options than the model; at a call if the mapped state
            lacks an entry, or has another batch size.

    Reference:
        Dissertation, section 4.2 (plan in a simulation, act in the environment).

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner, ModelBasedControl
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> model, real = ChainEnv(length=5), ChainEnv(length=5)
        >>> policy = ModelBasedControl(MCTSPlanner(model), env=real)
        >>> td = real.rollout(10, policy=policy)
        >>> td["next", "reward"].sum().item(), td["num_plans"].flatten().tolist()
        (1.0, [1, 2, 3, 4])
    """

    def __init__(
        self,
        planner: MCTSPlanner,
        state_map: StateMap | None = None,
        *,
        env: EnvBase | None = None,
        replan_every: int | None = 1,
        max_plan_length: int = 64,
    ) -> None:
        super().__init__()
        if state_map is not None and not callable(state_map):
            raise TypeError(f"state_map must be callable on a tensordict; got {state_map!r}.")
        self.policy = HierarchicalPolicy(
            planner, replan_every=replan_every, max_plan_length=max_plan_length
        )
        self.__dict__["state_map"] = state_map  # its owner trains and moves it
        self.out_keys = list(self.policy.out_keys)
        read = self.policy.in_keys if state_map is None else getattr(state_map, "in_keys", [])
        self.in_keys = [unravel_key(key) for key in read]
        self._starts = EpisodeStarts(self.in_keys, self.policy._plan_keys[:4])
        if env is not None:
            instance("ModelBasedControl", "env", env, EnvBase)
            self._check(env, planner)

    def _check(self, env: EnvBase, planner: MCTSPlanner) -> None:
        name, key = env_name(env), planner.option_key
        model = planner.simulator.env
        theirs: TensorSpec | None = env.full_action_spec.get(key, None)
        ours = model.full_action_spec[key]
        spaces = [getattr(spec, "space", None) for spec in (theirs, ours)]
        if theirs is None or type(theirs) is not type(ours) or spaces[0] != spaces[1]:
            raise ValueError(
                f"The options of the real env and of the model must be the same; {name} has "
                f"{theirs} under {key!r}, the model {ours}. Put both under an OptionTransform with "
                f"the same worker."
            )
        available = {unravel_key(k) for k in env.full_observation_spec.keys(True, True)}
        available |= {unravel_key(k) for k in env.full_state_spec.keys(True, True)}
        missing = _missing(self.in_keys, available)
        if missing:
            raise ValueError(
                f"ModelBasedControl reads {missing}, which {name} does not write: it writes "
                f"{sorted(map(str, available))}. Pass a state_map that makes the model's state "
                f"from those."
            )

    def reset(self) -> None:
        """Forget what the policy keeps between decisions."""
        self.policy.reset()
        self._starts.forget()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the option to take, and the plan that it begins."""
        if self.state_map is None:
            self.policy(tensordict)
            return tensordict
        state = self.state_map(tensordict)
        missing = _missing(self.policy.in_keys, set(state.keys(True, True)))
        if missing or state.batch_size != tensordict.batch_size:
            raise ValueError(
                f"state_map must return the model's state {list(map(str, self.policy.in_keys))} of "
                f"batch size {list(tensordict.batch_size)}; got batch size "
                f"{list(state.batch_size)}, without {missing}."
            )
        state = state.copy()
        for key in (*self.out_keys, "is_init", "_step", "done"):
            value = tensordict.get(key, None)
            if value is not None:  # the plan so far, and who needs none
                state.set(key, value)
        length = state.get("plan_length", None)
        if length is not None:  # the real env sees more starts than the model's state shows
            begins = self._starts.seen(tensordict).unsqueeze(-1)
            state.set("plan_length", length.masked_fill(begins, 0))
        self.policy(state)
        for key in self.out_keys:
            tensordict.set(key, state.get(key))
        self._starts.remember(tensordict)
        return tensordict

    def __getstate__(self) -> dict[str, Any]:
        starts = EpisodeStarts(self.in_keys, self.policy._plan_keys[:4])  # what was seen stays
        return {**super().__getstate__(), "_starts": starts}


def _missing(keys: Sequence[NestedKey], available: set[NestedKey]) -> list[NestedKey]:
    return [key for key in keys if key not in available]


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
        instance("GoalPlanner", "planner", planner, MCTSPlanner)
        if not callable(to_macro):
            raise TypeError(f"to_macro must be callable on a tensordict; got {to_macro!r}.")
        self.planner, self.to_macro = planner, to_macro
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
