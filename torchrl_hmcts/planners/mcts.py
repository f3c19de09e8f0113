"""Monte Carlo tree search over the options of a macro environment.

Letters: *B batch of roots, A options, m outcomes of one wave.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Compose, EnvBase

from torchrl_hmcts.planners.backups import Backup, MeanBackup
from torchrl_hmcts.planners.budget import SearchBudget
from torchrl_hmcts.planners.choices import BestPlan, FinalChoice, HighestValue, MostVisited
from torchrl_hmcts.planners.novelty import NoveltyTest
from torchrl_hmcts.planners.plan import Plan, extract_plans
from torchrl_hmcts.planners.search import Outcomes, Search, Wave
from torchrl_hmcts.planners.simulator import Simulator
from torchrl_hmcts.planners.tree_policies import UCT, TreePolicy

Evaluator = Callable[[TensorDictBase], Tensor]


@dataclass(frozen=True)
class SearchProgress:
    """What a progress display is told after every wave."""

    num_roots: int
    num_active: int
    num_found: int
    expansions: int
    base_steps: int
    seconds: float


class MCTSPlanner(TensorDictModuleBase):
    r"""Plans over the options of a macro environment by Monte Carlo tree search.

    A policy: it reads a state and writes the option to take, so that
    ``macro_env.rollout(n, policy=planner)`` is the hierarchical agent. An edge of its tree is an
    option ``o`` that lasted ``k`` base steps, earned ``R`` and led to ``s'``:

    .. math:: Q(s, o) = R + \gamma^k\, V(s')

    Each wave selects leaves in all trees, simulates their options in **one** step of the macro
    environment, and backs the outcomes up. A terminal state is worth nothing beyond its reward; a
    truncated one is worth what the leaf evaluator says. Subtrees in which nothing is left to find
    are closed and never simulated again.

    Args:
        env (EnvBase): the macro environment as simulator: any env under an ``OptionTransform``, or
            any env with a discrete action, that is stateless (``batch_locked=False``, its state in
            the tensordict). It is not stepped through ``env.step``; its own state, if any, is not
            touched.
        gamma (float, optional): discount per base step. Default: that of the env's
            ``OptionTransform``, else 0.99.
        tree_policy: :class:`UCT` (default, ``c=1``) or :class:`PUCT`.
        novelty (NoveltyTest, optional): which new nodes are worth searching, e.g.
            ``RadiusNovelty("position", 0.35)``. Default: all.
        leaf_evaluator (callable, optional): ``leaf_evaluator(td) -> values [m]`` or ``[m, 1]`` of
            new nodes, from their state and observation. Default: 0.
        option_prior (callable, optional): ``option_prior(td) -> probabilities [m, A]``. Default:
            uniform.
        backup: :class:`MeanBackup` (default) or :class:`MaxBackup`.
        final_choice: :class:`BestPlan` (default), :class:`MostVisited` or :class:`HighestValue`.
        budget (SearchBudget): limits per root. Default: 1,000 expansions, until a plan is found.
        expand: ``"all"`` simulates every option of a leaf at once (default), ``"one"`` only the
            option that the tree policy chooses, as in the textbook.
        leaves_per_wave (int): leaves of each root that share a simulator call. More are faster for
            few roots and search less selectively. Default 1.
        duration_key, mask_key (NestedKey): entries of the env with the base steps of a step, int64
            ``[*B, 1]`` (1 if the env has none), and the options that may be taken, bool ``[*B,
            A]`` (all if it has none).
        progress (callable, optional): called with a :class:`SearchProgress` after every wave.

    Writes: the env's action (the option), and ``"plan_found"`` (bool ``[*B, 1]``), ``"root_value"``
    (float ``[*B, 1]``), ``"root_visits"`` (int64 ``[*B, A]``), ``"num_expansions"`` and
    ``"num_simulated_steps"`` (int64 ``[*B, 1]``).

    Raises:
        ValueError: at construction if the env cannot be set to a state or its action is not
            discrete; at the call if an entry of the state is missing or not finite, or no option
            may be taken.

    Reference:
        Dissertation, sections 2.4.2, 3.2.1 and 4.2; Kocsis and Szepesvari 2006.

    Examples:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=5)
        >>> planner = MCTSPlanner(env)
        >>> env.rollout(10, policy=planner)["next", "reward"].sum().item()
        1.0
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        gamma: float | None = None,
        tree_policy: TreePolicy | None = None,
        novelty: NoveltyTest | None = None,
        leaf_evaluator: Evaluator | None = None,
        option_prior: Evaluator | None = None,
        backup: Backup | None = None,
        final_choice: FinalChoice | None = None,
        budget: SearchBudget | None = None,
        expand: Literal["all", "one"] = "all",
        leaves_per_wave: int = 1,
        duration_key: NestedKey = "duration",
        mask_key: NestedKey = "action_mask",
        progress: Callable[[SearchProgress], None] | None = None,
    ) -> None:
        super().__init__()
        if expand not in ("all", "one"):
            raise ValueError(f"MCTSPlanner: expand is 'all' or 'one'; got {expand!r}.")
        if leaves_per_wave < 1:
            raise ValueError(f"MCTSPlanner needs leaves_per_wave >= 1; got {leaves_per_wave}.")
        if gamma is None:
            gamma = _option_gamma(env)
        if not 0.0 < gamma <= 1.0:
            raise ValueError(f"MCTSPlanner needs a discount gamma in (0, 1]; got {gamma}.")
        extra = list(novelty.in_keys) if novelty is not None else []
        for part in (leaf_evaluator, option_prior):
            extra += [unravel_key(k) for k in getattr(part, "in_keys", ())]
        self.simulator = Simulator(
            env, extra_keys=extra, duration_key=duration_key, mask_key=mask_key
        )
        self.gamma = gamma
        self.tree_policy = UCT() if tree_policy is None else tree_policy
        self.novelty = novelty
        self.__dict__["leaf_evaluator"] = leaf_evaluator
        self.__dict__["option_prior"] = option_prior
        self.backup = MeanBackup() if backup is None else backup
        self.final_choice = BestPlan() if final_choice is None else final_choice
        self.budget = SearchBudget() if budget is None else budget
        self.expand = expand
        self.leaves_per_wave = leaves_per_wave
        self.progress = progress
        self.option_key = self.simulator.option_key
        self.num_options = self.simulator.num_options
        self.in_keys = list(self.simulator.root_keys)
        self.out_keys = [
            self.option_key,
            "plan_found",
            "root_value",
            "root_visits",
            "num_expansions",
            "num_simulated_steps",
        ]
        self.last_search: Search | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Search from every state of the tensordict and write the options to take."""
        search = self.search(tensordict)
        shape = tensordict.batch_size
        device = self.simulator.env.device
        option = self.simulator.encode(torch.from_numpy(self._choose(search)).view(shape))
        tree = search.tree

        def column(array: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).view(*shape, 1)

        entries = {
            self.option_key: option,
            "plan_found": column(search.best_node >= 0),
            "root_value": column(tree.nodes["value"][:, 0]),
            "root_visits": torch.from_numpy(tree.edges["visits"][:, 0].astype(np.int64)).view(
                *shape, self.num_options
            ),
            "num_expansions": column(search.num_expansions),
            "num_simulated_steps": column(search.num_base_steps),
        }
        for key, value in entries.items():
            tensordict.set(key, value.to(device) if device is not None else value)
        return tensordict

    def planning(self, td: TensorDictBase) -> Tensor:
        """Return the options to take ``[*B]``; the form of TorchRL's planners."""
        return self.forward(td.copy()).get(self.option_key)

    def plan(self, td: TensorDictBase) -> Plan:
        """Search from every state of ``td`` and return the best plans as sequences of options."""
        plans = extract_plans(self.search(td))
        return plans.reshape(td.batch_size)

    def search(self, td: TensorDictBase) -> Search:
        """Search from every state of ``td`` (any batch shape, flattened) and return the trees."""
        begin = time.perf_counter()
        root = self.simulator.root(td)
        num_roots = root.batch_size[0]
        search = Search(
            num_roots,
            self.num_options,
            tree_policy=self.tree_policy,
            backup=self.backup,
            novelty=self.novelty,
            expand=self.expand,
            leaves_per_wave=self.leaves_per_wave,
        )
        with torch.no_grad():
            done = self.simulator.done(root)
            masks = self.simulator.masks(root)
            if len(masks) and not (masks.any(-1) | done).all():
                bad = int(np.flatnonzero(~(masks.any(-1) | done))[0])
                raise ValueError(
                    f"Root {bad} has no option that may be taken: its action mask is all False. "
                    f"Plan from a state that is not a dead end, or mark it as done."
                )
            values = self._evaluate(root, self.simulator.terminated(root))
            search.start(values, done, self._priors(root), masks, self._features(root))
            roots = np.arange(num_roots)
            search.tree.set_states(roots, np.zeros_like(roots), self.simulator.state(root))
            self._grow(search, begin)
        self.last_search = search
        return search

    def _grow(self, search: Search, begin: float) -> None:
        budget = self.budget
        active = np.flatnonzero(~search.exhausted(np.arange(search.num_roots)))
        while len(active):
            wave = search.select(active)
            if len(wave.roots):
                self._simulate(search, wave)
            seconds = time.perf_counter() - begin
            if self.progress is not None:
                self.progress(
                    SearchProgress(
                        num_roots=search.num_roots,
                        num_active=len(active),
                        num_found=int((search.best_node >= 0).sum()),
                        expansions=int(search.num_expansions.sum()),
                        base_steps=int(search.num_base_steps.sum()),
                        seconds=seconds,
                    )
                )
            if budget.seconds is not None and seconds >= budget.seconds:
                return
            spent = search.num_expansions[active]
            over = spent >= budget.expansions
            if budget.base_steps is not None:
                over |= search.num_base_steps[active] >= budget.base_steps
            if budget.until_plan:
                since = search.expansions_to_plan[active]
                over |= (since >= 0) & (spent >= since + budget.improve_expansions)
            active = active[~over]
            stuck = search.exhausted(active)
            if stuck.any():
                hopeless = [b for b in active[stuck] if not search.relax(int(b))]
                active = active[~np.isin(active, hopeless)]

    def _simulate(self, search: Search, wave: Wave) -> None:
        simulator = self.simulator
        states = search.tree.get_states(wave.roots, wave.nodes, simulator.state_keys)
        after = simulator.step(states, wave.options)
        terminated, done = simulator.terminated(after), simulator.done(after)
        durations = simulator.durations(after)
        discounts = np.where(terminated, 0.0, self.gamma**durations).astype(np.float32)
        outcomes = Outcomes(
            rewards=simulator.rewards(after),
            discounts=discounts,
            durations=durations,
            done=done,
            values=self._evaluate(after, terminated),
            priors=self._priors(after),
            masks=simulator.masks(after),
        )
        nodes = search.insert(wave, outcomes, self._features(after))
        search.tree.set_states(wave.roots, nodes, simulator.state(after))

    def _evaluate(self, td: TensorDictBase, terminated: np.ndarray) -> np.ndarray:
        if self.leaf_evaluator is None:
            return np.zeros(td.batch_size[0], np.float32)
        values = _as_tensor(self.leaf_evaluator(td), "leaf_evaluator")
        num_states = td.batch_size[0]
        if tuple(values.shape) not in ((num_states,), (num_states, 1)):
            raise ValueError(
                f"The leaf evaluator returned shape {list(values.shape)}; it must give one value "
                f"per state, [{num_states}] or [{num_states}, 1]."
            )
        values_np: np.ndarray = values.reshape(-1).to(torch.float32).cpu().numpy()
        if not np.isfinite(values_np).all():
            raise ValueError(
                f"The leaf evaluator returned {values_np[~np.isfinite(values_np)][0]}. Values must "
                f"be finite; check the network's input and weights."
            )
        return np.where(terminated, np.float32(0.0), values_np)

    def _priors(self, td: TensorDictBase) -> np.ndarray:
        if self.option_prior is None:
            return np.zeros((0, self.num_options), np.float32)
        priors = _as_tensor(self.option_prior(td), "option_prior")
        shape = (td.batch_size[0], self.num_options)
        if tuple(priors.shape) != shape:
            raise ValueError(
                f"The option prior returned shape {list(priors.shape)}; it must give one "
                f"probability per node and option, {list(shape)}."
            )
        if not (torch.isfinite(priors) & (priors >= 0)).all():
            bad = priors[~(torch.isfinite(priors) & (priors >= 0))][0].item()
            raise ValueError(
                f"The option prior returned {bad}. Probabilities must be finite and not negative; "
                f"apply a softmax to logits."
            )
        return priors.to(torch.float32).cpu().contiguous().numpy()

    def _features(self, td: TensorDictBase) -> np.ndarray | None:
        return None if self.novelty is None else self.novelty.features(td)

    def _choose(self, search: Search) -> np.ndarray:
        edges = search.tree.edges[:, 0]
        visits = edges["visits"].astype(np.int64)
        q = np.where(visits > 0, edges["reward"] + edges["discount"] * edges["value"], -np.inf)
        if isinstance(self.final_choice, HighestValue):
            return q.argmax(-1)
        order = np.lexsort((-q, -visits), axis=-1)[:, 0]
        if isinstance(self.final_choice, MostVisited):
            return order
        planned = [
            search.tree.options(b, int(node))[0] if node > 0 else order[b]
            for b, node in enumerate(search.best_node)
        ]
        return np.array(planned, np.int64)

    def __repr__(self) -> str:
        return (
            f"MCTSPlanner(num_options={self.num_options}, tree_policy={self.tree_policy}, "
            f"novelty={self.novelty}, budget={self.budget})"
        )


def _as_tensor(value: Tensor, name: str) -> Tensor:
    if not isinstance(value, Tensor):
        raise TypeError(
            f"{name} must return a tensor; got {type(value).__name__}. Wrap a TensorDictModule as "
            f'lambda td: module(td)["state_value"].'
        )
    return value


def _option_gamma(env: EnvBase) -> float:
    """The discount of the env's OptionTransform, the last one if there are several; else 0.99."""
    transform = getattr(env, "transform", None)
    transforms = transform if isinstance(transform, Compose) else [transform]
    for candidate in reversed(list(transforms)):
        gamma = getattr(candidate, "gamma", None)
        if gamma is not None and hasattr(candidate, "num_options"):
            return float(gamma)
    return 0.99
