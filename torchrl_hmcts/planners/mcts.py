"""Monte Carlo tree search over the options of a macro environment.

Letters: *B batch of roots, A options, m outcomes of one wave.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_hmcts import notebook
from torchrl_hmcts.checks import instance, no_class, real_number, whole_number
from torchrl_hmcts.nesting import innermost, option_gamma
from torchrl_hmcts.planners.budget import ProgressiveWidening, SearchBudget, TreeRollout
from torchrl_hmcts.planners.evaluation import Evaluator, NodeEvaluator
from torchrl_hmcts.planners.novelty import NoveltyTest
from torchrl_hmcts.planners.plan import Plan, SearchProgress, extract_plans
from torchrl_hmcts.planners.root_options import (
    BestPlan,
    DirichletNoise,
    FinalChoice,
    MostVisited,
    gumbel_choice,
)
from torchrl_hmcts.planners.search import Search
from torchrl_hmcts.planners.search_loop import SearchLoop
from torchrl_hmcts.planners.settings import SearchSettings
from torchrl_hmcts.planners.simulator import Simulator
from torchrl_hmcts.planners.simulator_checks import check_masks
from torchrl_hmcts.planners.subtree import check_successor, keep_subtrees
from torchrl_hmcts.planners.transpositions import Transpositions
from torchrl_hmcts.planners.tree_policies import UCT, TreePolicy

_WRITTEN = (
    *("plan_found", "root_value", "root_visits"),
    *("num_simulations", "num_expansions", "num_simulated_steps"),
)
# Where people look for what is an argument of another part.
_ELSEWHERE = {
    **{
        name: f"budget=SearchBudget({name.removeprefix('num_')}=...)"
        for limit in ("simulations", "expansions", "base_steps", "seconds", "nodes")
        for name in (limit, f"num_{limit}")
    },
    **dict.fromkeys(("c", "c_puct", "exploration"), "tree_policy=UCT(c=...) or PUCT(c=...)"),
    **dict.fromkeys(("value", "value_net"), "leaf_evaluator=ValueEvaluator(module)"),
    **dict.fromkeys(("policy", "prior"), "option_prior=ModulePrior(module)"),
    **dict.fromkeys(
        ("worker", "max_steps", "num_options"),
        "env=TransformedEnv(env, OptionTransform(worker, num_options, max_steps))",
    ),
}
_PARTS = {part.name for part in fields(SearchSettings)}


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

    Root ``b`` of a call with seed ``s`` draws its random numbers from ``s + b``, so that its tree
    does not depend on the roots beside it (with several waves in flight: a single root's only).

    Args:
        env (EnvBase): the macro environment as simulator: any env under an ``OptionTransform``, or
            any env with a discrete action, that is stateless (``batch_locked=False``, its state in
            the tensordict) or can be set to a state by ``reset(td, set_state=True)``; a search
            sets the latter back to the state of the call. Transforms that remember something
            outside the tensordict are refused, but ``CatFrames``: every node has its own frames.
        gamma (float, optional): discount per base step. Default: that of the env's
            ``OptionTransform``, through any nesting of envs; 0.99 for an env without durations.
        tree_policy, backup, novelty, transpositions, chance, rollout: see :class:`SearchSettings`.
            ``planner.settings`` holds them; each can be read and assigned as an attribute.
        expand, leaves_per_wave, waves_in_flight, exhausted: see there, too.
        leaf_evaluator (callable, optional): ``leaf_evaluator(td) -> values [m]`` or ``[m, 1]`` of
            new nodes, or an :class:`Evaluation`: :class:`ValueEvaluator`,
            :class:`RolloutEvaluator`, :class:`PolicyValueEvaluator` or your own. Default: 0.
        option_prior (callable, optional): ``option_prior(td) -> probabilities [m, A]``:
            :class:`ModulePrior` or your own. Default: those of ``leaf_evaluator``, else uniform.
        root_noise (DirichletNoise, optional): noise in the prior of the roots. Default: none.
        final_choice: :class:`BestPlan` (default), :class:`MostVisited` (default with ``chance``),
            :class:`HighestValue` or :class:`SampledVisits`. :class:`Gumbel` has its own choice.
        budget (SearchBudget): limits per root. Default: 1,000 expansions, until a plan is found.
        duration_key, mask_key (NestedKey): entries of the env with the base steps of a step, int64
            ``[*B, 1]`` (None, or an env without it: 1), and the options that may be taken, bool
            ``[*B, A]`` (else all), which is not the mask of a worker's base actions.
        reward_key (NestedKey, optional): which reward, if the env has several.
        seed (int, optional): of the planner's random numbers; each call continues the stream.
            Default: drawn from torch's global generator when first needed.
        progress (callable, optional): called with a :class:`SearchProgress` after every wave.

    Writes: the env's action (the option), and ``"plan_found"`` (bool ``[*B, 1]``), ``"root_value"``
    (float ``[*B, 1]``), ``"root_visits"`` (int64 ``[*B, A]``), ``"num_simulations"``,
    ``"num_expansions"`` and ``"num_simulated_steps"`` (int64 ``[*B, 1]``).

    Raises:
        ValueError: at construction if the env cannot be set to a state or its action is not
            discrete; at the call if an entry of the state is missing or not finite, or no option
            may be taken.
        TypeError: if a part is of another kind.

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
        transpositions: Transpositions | None = None,
        chance: ProgressiveWidening | None = None,
        leaf_evaluator: Evaluator | None = None,
        option_prior: Evaluator | None = None,
        rollout: TreeRollout | None = None,
        root_noise: DirichletNoise | None = None,
        backup: Literal["mean", "max"] = "mean",
        final_choice: FinalChoice | None = None,
        budget: SearchBudget | None = None,
        expand: Literal["all", "one"] = "all",
        leaves_per_wave: int = 1,
        waves_in_flight: int = 1,
        exhausted: Literal["skip", "revisit"] = "skip",
        duration_key: NestedKey | None = "duration",
        mask_key: NestedKey | None = "action_mask",
        reward_key: NestedKey | None = None,
        seed: int | None = None,
        progress: Callable[[SearchProgress], None] | None = None,
    ) -> None:
        super().__init__()
        self.settings = SearchSettings(
            tree_policy=UCT() if tree_policy is None else tree_policy,
            backup=backup,
            novelty=novelty,
            transpositions=transpositions,
            chance=chance,
            rollout=rollout,
            expand=expand,
            leaves_per_wave=leaves_per_wave,
            waves_in_flight=waves_in_flight,
            exhausted=exhausted,
        )
        self.budget = SearchBudget() if budget is None else budget
        if gamma is not None:
            real_number("MCTSPlanner", "gamma", gamma, above=0.0, most=1.0)
        if root_noise is not None:
            instance("MCTSPlanner", "root_noise", root_noise, DirichletNoise)
        readers = (novelty, transpositions, leaf_evaluator, option_prior)
        self.simulator = Simulator(
            env,
            extra_keys=[key for part in readers for key in getattr(part, "in_keys", ())],
            duration_key=duration_key,
            mask_key=mask_key,
            reward_key=reward_key,
        )
        self.option_key, self.num_options = self.simulator.option_key, self.simulator.num_options
        # after the simulator's check: it must be an env
        self.gamma = option_gamma(env, self.simulator.duration_key) if gamma is None else gamma
        # Not a sub-module: training or moving the planner must not change its owner's networks.
        self.evaluate = NodeEvaluator(leaf_evaluator, option_prior, self.num_options)
        self.evaluate.bind(self.simulator, self.gamma)
        self.root_noise = root_noise
        self._gumbel_choice = final_choice is None and self.settings.is_gumbel
        if final_choice is None:
            final_choice = BestPlan() if chance is None else MostVisited()
        no_class("MCTSPlanner", "final_choice", final_choice)
        if not hasattr(final_choice, "choose"):
            raise TypeError(
                f"final_choice needs choose(search), e.g. BestPlan(); got {final_choice}."
            )
        if progress is not None and not callable(progress):
            raise TypeError(f"progress must be callable; got {progress!r}.")
        self.final_choice = final_choice
        self.progress = progress
        self.set_seed(seed)
        self.in_keys = list(self.simulator.root_keys)
        self.out_keys = [self.option_key, *_WRITTEN]
        self._last_search: Search | None = None

    def __new__(cls, *args: Any, **kwargs: Any) -> MCTSPlanner:  # before __init__ refuses a name
        for name in kwargs:
            if name in _ELSEWHERE:
                raise TypeError(f"MCTSPlanner has no {name}. Write {_ELSEWHERE[name]}.")
        return super().__new__(cls, *args, **kwargs)

    @property
    def last_search(self) -> Search:
        """The latest search, also while it runs and after an interruption.

        Raises:
            RuntimeError: if there was none; :attr:`has_searched` tells.
        """
        if self._last_search is None:
            raise RuntimeError(
                "The planner has not searched yet. Write planner.plan(env.reset()) first."
            )
        return self._last_search

    @last_search.setter
    def last_search(self, search: Search | None) -> None:
        self._last_search = search

    @property
    def has_searched(self) -> bool:
        """True if there is a :attr:`last_search`."""
        return self._last_search is not None

    def __getattr__(self, name: str) -> Any:
        if name in _PARTS:
            return getattr(self.settings, name)
        return super().__getattr__(name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _PARTS:
            name, value = "settings", replace(self.settings, **{name: value})
        if name == "settings":
            instance("MCTSPlanner", name, value, SearchSettings)
            if "budget" in self.__dict__:
                value.check_simulations(self.budget.simulations)
        elif name == "budget":
            instance("MCTSPlanner", name, value, SearchBudget)
            self.settings.check_simulations(value.simulations)
        super().__setattr__(name, value)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Search from every state of the tensordict and write the options to take."""
        search = self.search(tensordict)
        shape = tensordict.batch_size
        device = self.simulator.env.device
        option = self.simulator.encode(torch.from_numpy(self.choose(search)).view(shape))
        tree = search.tree

        def column(array: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).view(*shape, 1)

        visits = torch.from_numpy(tree.edges["visits"][:, 0].astype(np.int64))
        entries = (
            option,
            column(search.best_node >= 0),
            column(tree.nodes["value"][:, 0]),
            visits.view(*shape, self.num_options),
            column(search.num_simulations),
            column(search.num_expansions),
            column(search.num_base_steps),
        )
        for key, value in zip(self.out_keys, entries, strict=True):
            tensordict.set(key, value.to(device) if device is not None else value)
        return tensordict

    def plan(self, td: TensorDictBase) -> Plan:
        """Search from every state of ``td`` and return the best plans as sequences of options."""
        return extract_plans(self.search(td)).reshape(td.batch_size)

    def search(self, td: TensorDictBase, *, seed: int | None = None) -> Search:
        """Search from every state of ``td`` (any batch shape, flattened) and return the trees.

        While it runs, and after an interruption, ``last_search`` holds what was found so far.
        """
        begin = time.perf_counter()
        search = self.plant(td, seed=seed)
        try:
            return self._grow(search, begin, np.arange(search.num_roots))
        finally:
            self.simulator.leave(td)

    def plant(self, td: TensorDictBase, *, seed: int | None = None) -> Search:
        """Plant a tree at every state of ``td``; nothing is simulated until :meth:`resume`."""
        root = self.simulator.root(td)
        num_roots = root.batch_size[0]
        capacity = self._capacity(num_roots)
        search = Search(num_roots, self.num_options, self.settings, capacity=capacity)
        search.seed(self._draw_seed() if seed is None else seed)
        self._plant(search, root, None)
        env = innermost(self.simulator.given_env)
        search.tree.draw_map = env.draw_map if hasattr(type(env), "draw_map") else None
        self.last_search = search
        return search

    def _capacity(self, num_roots: int) -> int:
        """Nodes to make room for at once: all that the budget allows, if they are not very many."""
        budget, settings = self.budget, self.settings
        limits = [x for x in (budget.simulations, budget.nodes) if x is not None]
        per_wave = settings.leaves_per_wave * settings.waves_in_flight * self.num_options
        if not limits or num_roots * min(limits) > 2**20:
            return 64
        return min(limits) + per_wave + 1

    def resume(self, search: Search, *, where: Tensor | None = None) -> Search:
        """Continue a search, with a fresh budget; with ``Gumbel`` to the end of its schedule.

        Only the roots ``where`` (bool ``[*B]``) are searched, all by default. The search takes the
        planner's present settings.

        Raises:
            ValueError: if the search was planted with another backup, novelty test or the like.
        """
        if search.settings is not self.settings:
            check_successor(search.settings, self.settings)
            search.follow(self.settings)
        return self._grow(search, time.perf_counter(), _rows(search, where))

    def _grow(self, search: Search, begin: float, rows: np.ndarray) -> Search:
        loop = SearchLoop(
            search,
            self.simulator,
            self.evaluate,
            gamma=self.gamma,
            budget=self.budget,
            progress=self.progress,
        )
        with self.simulator.searching():
            return loop.run(begin, rows)

    def advance(
        self,
        search: Search,
        options: Tensor,
        td: TensorDictBase,
        *,
        where: Tensor | None = None,
        seed: int | None = None,
    ) -> Tensor:
        """Move the roots of a search along: ``options`` were executed and led to ``td``.

        If the tree holds the state in ``td`` as an outcome of the options, bit for bit, its subtree
        is kept; otherwise a new tree is planted. Nothing is simulated until :meth:`resume`.

        Args:
            search: as :meth:`search` returned it.
            options: int64 ``[*B]``, or ``[*B, k]`` for k options in a row, padded with -1; -1 alone
                for a new tree.
            td: states ``[*B]`` after the options.
            where: bool ``[*B]``, the roots to move; the others stay as they are. Default: all.
            seed: as in :meth:`search`.

        Returns:
            Which subtrees were kept, bool ``[*B]``.

        Raises:
            ValueError: if the options or states do not fit the search.
        """
        shape = td.batch_size
        fits = options.shape[: len(shape)] == shape and options.ndim <= len(shape) + 1
        if shape.numel() != search.num_roots or not fits:
            raise ValueError(
                f"advance needs options [*B] or [*B, k] and states [*B] for the {search.num_roots} "
                f"roots of the search; got options {list(options.shape)}, states {list(shape)}."
            )
        if options.numel() and int(options.max()) >= self.num_options:
            raise ValueError(
                f"advance needs options below {self.num_options}; got {int(options.max())}."
            )
        rows = _rows(search, where)
        if not len(rows):
            return torch.zeros(shape, dtype=torch.bool)
        index = torch.from_numpy(rows)
        root = self.simulator.root(td.flatten()[index])
        taken = options.reshape(search.num_roots, -1)[index].tolist()
        state, done = self.simulator.state(root), self.simulator.done(root)
        search.seed(self._draw_seed() if seed is None else seed)
        kept = keep_subtrees(search, rows, taken, state, done, self.simulator.state_keys)
        fresh = np.flatnonzero(~kept[rows])
        if len(fresh):
            self._plant(search, root[torch.from_numpy(fresh)], rows[fresh])
        if self.root_noise is not None and kept.any():
            self.root_noise.add(search, np.flatnonzero(kept))
        self.last_search = search
        return torch.from_numpy(kept).view(shape)

    def set_seed(self, seed: int | None) -> None:
        """Begin the random numbers again, with a ``seed`` as of the constructor."""
        if seed is not None:
            whole_number("MCTSPlanner", "seed", seed)
        self._seeds = None if seed is None else np.random.SeedSequence(int(seed))

    def _draw_seed(self) -> int:
        """The seed of the next call."""
        if self._seeds is None:
            self._seeds = np.random.SeedSequence(int(torch.empty((), dtype=torch.int64).random_()))
        return int(self._seeds.spawn(1)[0].generate_state(1, np.uint32)[0])

    def _plant(self, search: Search, root: TensorDictBase, rows: np.ndarray | None) -> None:
        """Plant the roots ``rows`` of a search, all by default, at the states ``root``."""
        simulator, settings = self.simulator, self.settings
        where = np.arange(search.num_roots) if rows is None else rows
        with torch.no_grad(), simulator.searching():
            check_masks(simulator.masks(root), simulator.done(root), where)
            seeds = lambda: search.seeds[where]  # noqa: E731
            ended = simulator.terminated(root)
            known = self.evaluate.describe(root, ended, simulator, settings, seeds)
        search.plant(known, rows)
        search.tree.set_states(where, np.zeros_like(where), simulator.state(root))
        if self.root_noise is not None:
            self.root_noise.add(search, where)

    def choose(self, search: Search) -> np.ndarray:
        """Return the option to take in each root of a search, int64 ``[B]``."""
        return gumbel_choice(search) if self._gumbel_choice else self.final_choice.choose(search)

    def _repr_html_(self) -> str:
        tree = self._last_search.tree if self._last_search is not None else None
        return notebook.shown(repr(self)) + (tree._repr_html_() if tree is not None else "")

    def __repr__(self) -> str:
        return (
            f"MCTSPlanner(num_options={self.num_options}, tree_policy={self.tree_policy}, "
            f"novelty={self.novelty}, budget={self.budget})"
        )


def _rows(search: Search, where: Tensor | None) -> np.ndarray:
    """The roots that a mask names, all by default."""
    if where is None:
        return np.arange(search.num_roots)
    if where.numel() != search.num_roots:
        raise ValueError(
            f"where needs one entry for each of the {search.num_roots} roots of the search; got "
            f"{list(where.shape)}."
        )
    return np.flatnonzero(where.reshape(-1).cpu().numpy())
