"""Executing plans: a policy that plans, follows its plan and plans again; goals for a worker.

Letters: *B batch of the tensordict, L ``max_plan_length`` or goals, f numbers of the divergence
entries, m states, D coordinates of a goal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from torchrl_hmcts.checks import instance, nested_key, nested_keys, real_number, whole_number
from torchrl_hmcts.nesting import env_name
from torchrl_hmcts.planners.mcts import MCTSPlanner
from torchrl_hmcts.planners.plan import Plan, extract_plans
from torchrl_hmcts.planners.search import Search


class HierarchicalPolicy(TensorDictModuleBase):
    r"""Follows a planner's plan option by option, and plans again when it must.

    It plans again at the plan's end (open loop, the default), after every ``replan_every`` options,
    or when the state :math:`s_i` after the i-th option is not the state :math:`\hat s_i` that the
    plan predicted there (closed loop):

    .. math:: \lVert \phi(s_i) - \phi(\hat s_i) \rVert > \text{divergence}

    with :math:`\phi` the entries ``divergence_key`` side by side. Where no plan is found, the
    planner's choice is taken, and a new plan is made after it.

    The plan is kept in the tensordict, as the state of a recurrent policy is: ``"plan"`` (int64
    ``[*B, L]``), ``"plan_length"``, ``"plan_step"`` and ``"num_plans"`` (int64 ``[*B, 1]``, plans
    so far; with TorchRL's ``InitTracker``, of the episode), and with ``divergence``
    ``"plan_states"`` (float32 ``[*B, L + 1, f]``). Every episode begins with a new plan. The policy
    detects a new episode by the last step: it ended the old one, or led to another state than the
    present one. In a tensordict that was copied before the step it cannot; append TorchRL's
    ``InitTracker`` or ``StepCounter`` to the env there.

    The policy may act in another env than the planner's, e.g. one that cannot be set to a state,
    under an :class:`~torchrl_hmcts.transforms.OptionTransform` with the same worker. ``state_map``
    then makes the state to plan from of that env's entries, :math:`\hat s = \mathrm{map}(o)`. Plan
    again after every option (``replan_every=1``), since options end elsewhere than predicted.

    Args:
        planner (MCTSPlanner): the manager.
        max_plan_length (int): options of a plan that are kept, L. Default 64.
        replan_every (int, optional): options after which to plan again before the plan has ended.
            With 1 each option is the planner's ``final_choice``. Default: at the plan's end.
        divergence (float, optional): distance from the predicted state, in units of the entries,
            above which to plan again. Default: states are not compared.
        divergence_key (NestedKey or sequence of them, optional): entries of the simulator's state
            or observation that are compared, e.g. ``"position"``.
        reuse (bool): keep the trees between decisions, in one rollout at a time: if the executed
            options led to a state in the tree, its subtree is searched further
            (:meth:`MCTSPlanner.advance`). Default ``False``.
        state_map (callable, optional): ``state_map(td) -> TensorDict [*B]`` of the planner's
            ``in_keys``. Default: the env in which the policy acts writes them itself.
        env (EnvBase, optional): the macro env to act in, checked once against the planner's.

    Raises:
        ValueError: if a number is out of range, ``divergence`` and ``divergence_key`` do not come
            together, the planner's env has no such entry, or ``env`` has other options; at a call
            if the mapped state lacks an entry or has another batch size.
        TypeError: if an argument is of another kind.

    Reference:
        Dissertation, sections 3.2.1 and 4.2: plan in a simulation, execute in the environment.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.planners import HierarchicalPolicy, MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> policy = HierarchicalPolicy(MCTSPlanner(env))
        >>> env.rollout(10, policy=policy)["plan_step"].flatten().tolist()
        [1, 2, 3]
        >>> policy = HierarchicalPolicy(  # a model that has another name for its state
        ...     MCTSPlanner(env), state_map=lambda td: TensorDict({"state": td["place"]}, []))
        >>> policy(TensorDict({"place": torch.tensor(2)}, []))["action"]
        tensor(1)
    """

    def __init__(
        self,
        planner: MCTSPlanner,
        *,
        max_plan_length: int = 64,
        replan_every: int | None = None,
        divergence: float | None = None,
        divergence_key: NestedKey | Sequence[NestedKey] | None = None,
        reuse: bool = False,
        state_map: Callable[[TensorDictBase], TensorDictBase] | None = None,
        env: EnvBase | None = None,
    ) -> None:
        super().__init__()
        instance("HierarchicalPolicy", "planner", planner, MCTSPlanner)
        owner = "HierarchicalPolicy"
        self.max_plan_length = whole_number(owner, "max_plan_length", max_plan_length, least=1)
        if replan_every is not None:
            whole_number(owner, "replan_every", replan_every, least=1)
        if (divergence is None) != (divergence_key is None):
            raise ValueError(
                f"HierarchicalPolicy compares divergence_key with the plan and plans again above "
                f"divergence; got divergence={divergence} and divergence_key={divergence_key!r}. "
                f"Pass both or neither."
            )
        self.divergence_keys: list[NestedKey] = []
        if divergence is not None and divergence_key is not None:
            real_number(owner, "divergence", divergence, least=0.0)
            self.divergence_keys = nested_keys(owner, "divergence_key", divergence_key)
        self.planner, self.replan_every = planner, replan_every
        instance(owner, "reuse", reuse, bool)
        self.divergence, self.reuse = divergence, reuse
        planner.simulator.keep(self.divergence_keys)
        self._state_keys = list(dict.fromkeys([*planner.in_keys, *self.divergence_keys]))
        read = self._state_keys
        if state_map is not None:
            if not callable(state_map):
                raise TypeError(f"state_map must be callable on a tensordict; got {state_map!r}.")
            read = list(getattr(state_map, "in_keys", []))
        self.in_keys = [unravel_key(key) for key in read]
        self.__dict__["state_map"] = state_map  # its owner trains and moves it
        if env is not None:
            instance(owner, "env", env, EnvBase)
            self._check_env(env)
        self._plan_keys = ["plan", "plan_length", "plan_step", "num_plans"]
        if divergence is not None:
            self._plan_keys.append("plan_states")
        self.out_keys = [planner.option_key, *self._plan_keys]
        self._starts = EpisodeStarts(self.in_keys, self._plan_keys[:4])
        self.reset()

    def _check_env(self, env: EnvBase) -> None:
        name, key = env_name(env), self.planner.option_key
        model = self.planner.simulator.env
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
        missing = [k for k in self.in_keys if k not in available]
        if missing:
            raise ValueError(
                f"HierarchicalPolicy reads {missing}, which {name} does not write: it writes "
                f"{sorted(map(str, available))}. Pass a state_map that makes the model's state "
                f"from those."
            )

    def reset(self) -> None:
        """Forget the last step, and the trees that ``reuse`` keeps."""
        self._starts.forget()
        self._search: Search | None = None
        self._shape: torch.Size | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next option of each row's plan, and plan first where a plan is needed."""
        shape, state = tensordict.batch_size, self._state(tensordict)
        done, stepped = tensordict.get("done", None), tensordict.get("_step", None)
        kept = {key: tensordict.get(key, None) for key in self._plan_keys}
        if any(value is None for value in kept.values()):
            kept = self._no_plans(state)
        else:
            kept = {key: value.clone() for key, value in kept.items()}
            begins, is_init = self._starts.seen(tensordict), tensordict.get("is_init", None)
            for name in ("plan_length", "plan_step"):
                kept[name][begins] = 0
            if is_init is not None:
                kept["num_plans"][is_init.reshape(shape)] = 0
        plan, length, step = kept["plan"], kept["plan_length"], kept["plan_step"]
        needs = (step >= length).squeeze(-1)
        if self.replan_every is not None:
            needs = needs | (step >= self.replan_every).squeeze(-1)
        if self.divergence is not None:
            needs = needs | self._diverged(state, kept["plan_states"], step)
        if done is not None:
            needs = needs & ~done.reshape(shape)
        if stepped is not None:  # False where a rollout continues without the element
            needs = needs & stepped.reshape(shape)
        if needs.any():
            behind = torch.arange(self.max_plan_length, device=plan.device) >= step
            self._plan(state, needs, plan.masked_fill(behind, -1), kept)
        option = plan.gather(-1, step.clamp_max(self.max_plan_length - 1)).squeeze(-1)
        tensordict.set(self.planner.option_key, self.planner.simulator.encode(option))
        step += 1
        for key, value in kept.items():
            tensordict.set(key, value)
        self._starts.remember(tensordict)
        return tensordict

    def _state(self, td: TensorDictBase) -> TensorDictBase:
        """The state to plan from."""
        if self.state_map is None:
            return td
        state = self.state_map(td)
        missing = [key for key in self._state_keys if key not in state.keys(True, True)]
        if missing or state.batch_size != td.batch_size:
            raise ValueError(
                f"state_map must return the model's state {list(map(str, self._state_keys))} of "
                f"batch size {list(td.batch_size)}; got batch size {list(state.batch_size)}, "
                f"without {missing}."
            )
        for key in ("_step", "done"):
            if td.get(key, None) is not None:  # who needs no plan
                state = state.copy().set(key, td.get(key))
        return state

    def __getstate__(self) -> dict[str, Any]:
        starts = EpisodeStarts(self.in_keys, self._plan_keys[:4])  # what was seen stays here
        return {**super().__getstate__(), "_starts": starts}

    def _no_plans(self, td: TensorDictBase) -> dict[str, Tensor]:
        def zeros(*size: int, dtype: torch.dtype = torch.int64) -> Tensor:
            return torch.zeros((*td.batch_size, *size), dtype=dtype, device=td.device)

        kept = {"plan": zeros(self.max_plan_length)}
        kept.update({k: zeros(1) for k in ("plan_length", "plan_step", "num_plans")})
        if self.divergence is not None:
            width = self._features(td).shape[-1]
            kept["plan_states"] = zeros(self.max_plan_length + 1, width, dtype=torch.float32)
        return kept

    def _features(self, td: TensorDictBase) -> Tensor:
        """The divergence entries side by side, float32 ``[*batch, f]``."""
        parts = [td.get(k).to(torch.float32) for k in self.divergence_keys]
        return torch.cat([p.reshape(*td.batch_size, -1) for p in parts], -1)

    def _diverged(self, td: TensorDictBase, predicted: Tensor, step: Tensor) -> Tensor:
        at = step.clamp_max(self.max_plan_length).unsqueeze(-1)
        at = at.expand(*step.shape, predicted.shape[-1])
        distance = (self._features(td) - predicted.gather(-2, at).squeeze(-2)).norm(dim=-1)
        return ~(distance <= self.divergence)  # a state that is not a number has diverged too

    def _plan(
        self, td: TensorDictBase, needs: Tensor, executed: Tensor, kept: dict[str, Tensor]
    ) -> None:
        """Plan for the elements ``needs`` and write their plans."""
        found, fallback = self._searched(td, needs, executed)
        device = kept["plan"].device
        width = min(found.options.shape[-1], self.max_plan_length)
        plan = torch.zeros((len(found), self.max_plan_length), dtype=torch.int64)
        plan[:, :width] = found.options[:, :width].clamp_min(0)
        # Where the next option is planned again, only the first one counts: the planner's choice.
        chosen = ~found.found | (self.replan_every == 1)
        plan[chosen, 0] = fallback[chosen]
        length = torch.where(found.found, found.lengths.clamp_max(self.max_plan_length), 1)
        kept["plan"][needs] = plan.to(device)
        kept["plan_length"][needs] = length.unsqueeze(-1).to(device)
        kept["plan_step"][needs] = 0
        kept["num_plans"][needs] += 1
        if self.divergence is not None:
            states = kept["plan_states"][needs]
            states[:, : width + 1] = self._features(found.states)[:, : width + 1].to(device)
            kept["plan_states"][needs] = states

    def _searched(self, td: TensorDictBase, needs: Tensor, executed: Tensor) -> tuple[Plan, Tensor]:
        """The plans of the elements ``needs``, and the planner's choice for each."""
        planner = self.planner
        if not self.reuse:
            search = planner.search(td[needs])
            planner.simulator.leave(td)
            return extract_plans(search), torch.from_numpy(planner.choose(search))
        before, self._search = self._search, None  # an error leaves no half-moved trees behind
        if before is None or self._shape != td.batch_size:
            search = planner.plant(td)
        else:
            search = before
            planner.advance(search, executed, td, where=needs)
        planner.resume(search, where=needs)
        planner.simulator.leave(td)
        self._search, self._shape = search, td.batch_size
        rows = needs.reshape(-1).cpu()
        return extract_plans(search)[rows], torch.from_numpy(planner.choose(search))[rows]


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
        TypeError: if ``to_macro`` cannot be called.

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
        self.goal_key = nested_key("GoalPlanner", "goal_key", goal_key)
        planner.simulator.keep([self.goal_key])
        if in_keys is not None:
            self.in_keys = nested_keys("GoalPlanner", "in_keys", in_keys)

    def plan_goals(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Plan from the worker's states ``[m]``; return goals ``[m, L, D]`` and their number.

        The last goal is repeated; the lengths are int64 ``[m]``.
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


class EpisodeStarts:
    """Finds the elements in which an episode began since the policy acted last.

    What the last step led to is under ``"next"`` of the tensordict that the policy has written to.
    If it was the end or differs in ``state_keys``, the env was reset. Where ``plan_keys`` are not
    what the policy wrote, another rollout runs.
    """

    def __init__(self, state_keys: Sequence[NestedKey], plan_keys: Sequence[NestedKey]) -> None:
        self.state_keys, self.plan_keys = list(state_keys), list(plan_keys)
        self.forget()

    def forget(self) -> None:
        """Treat the next call as one of another rollout."""
        self._acted: TensorDictBase | None = None
        self._stale: TensorDictBase | None = None  # what was under "next" already
        self._wrote: dict[NestedKey, Tensor] = {}

    def remember(self, td: TensorDictBase) -> None:
        """Keep the tensordict that the policy has written to: a step adds its result there."""
        self._acted, self._stale = td, td.get("next", None)
        self._wrote = {key: td.get(key) for key in self.plan_keys}

    def seen(self, td: TensorDictBase) -> Tensor:
        """Return where an episode began, bool ``[*B]``."""
        shape = td.batch_size
        begins = torch.zeros(shape, dtype=torch.bool, device=td.device)
        is_init, count = td.get("is_init", None), td.get("step_count", None)
        if is_init is not None:
            begins = begins | is_init.reshape(shape)
        if count is not None and count.numel() == shape.numel():
            begins = begins | (count.reshape(shape) == 0)
        led_to = None if self._acted is None else self._acted.get("next", None)
        if led_to is None or led_to is self._stale or led_to.batch_size != shape:
            return begins
        done = led_to.get("done", None)
        other = torch.zeros_like(begins) if done is None else _any(done, shape)
        for key in self.state_keys or led_to.keys(True, True):
            one, two = led_to.get(key, None), td.get(key, None)
            if isinstance(one, Tensor) and isinstance(two, Tensor) and one.shape == two.shape:
                nan = (one != one) & (two != two)
                other = other | _any((one != two) & ~nan, shape)
        for key, wrote in self._wrote.items():
            carried = td.get(key, None)
            if carried is None or carried.shape != wrote.shape:
                return begins
            other = other & ~_any(carried != wrote, shape)
        return begins | other


def _any(flags: Tensor, shape: torch.Size) -> Tensor:
    """Whether any flag of an element is set, bool ``[*B]``."""
    return flags.reshape(*shape, -1).any(-1)
