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
from torchrl_hmcts.planners.chance import ProgressiveWidening
from torchrl_hmcts.planners.choices import BestPlan, FinalChoice, MostVisited
from torchrl_hmcts.planners.noise import DirichletNoise
from torchrl_hmcts.planners.novelty import NoveltyTest
from torchrl_hmcts.planners.plan import Plan, extract_plans
from torchrl_hmcts.planners.search import (
    NO_LIMIT,
    Outcomes,
    RootStates,
    Search,
    Wave,
    check_search,
)
from torchrl_hmcts.planners.simulator import Simulator
from torchrl_hmcts.planners.transpositions import Transpositions
from torchrl_hmcts.planners.tree import TERMINAL
from torchrl_hmcts.planners.tree_policies import UCT, Gumbel, TreePolicy
from torchrl_hmcts.planners.tree_rollout import TreeRollout

Evaluator = Callable[[TensorDictBase], Tensor]

# Entry with a seed for each state, int64 [m], given to evaluators that draw random numbers.
SEED_KEY = "_seed"

# Revisits in a row, without a limit of simulations, after which a root has nothing left to find.
_MAX_FRUITLESS_REVISITS = 10_000


@dataclass(frozen=True)
class SearchProgress:
    """What a progress display is told after every wave.

    ``search`` is the search as it stands; ``extract_plans(search)`` gives the best plans so far.

    Attributes:
        num_roots (int): roots of the search.
        num_active (int): roots whose search still goes on.
        num_found (int): roots with a plan.
        expansions (int): nodes expanded so far, of all roots.
        base_steps (int): base steps simulated so far, of all roots.
        seconds (float): since the search began.
        search (Search): the search as it stands, of B roots.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env, told = ChainEnv(length=4), []
        >>> _ = MCTSPlanner(env, progress=told.append).plan(env.reset())
        >>> told[-1].num_found, told[-1].num_roots
        (1, 1)
    """

    num_roots: int
    num_active: int
    num_found: int
    expansions: int
    base_steps: int
    seconds: float
    search: Search


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

    Root ``b`` of a call with seed ``s`` draws its random numbers (root noise, Gumbel, rollouts,
    sampled choices) from ``s + b``, so that it has the same tree whatever is searched beside it.

    Args:
        env (EnvBase): the macro environment as simulator: any env under an ``OptionTransform``, or
            any env with a discrete action, that is stateless (``batch_locked=False``, its state in
            the tensordict) or can be set to a state by ``reset(td, set_state=True)``. The planner
            changes the state of an env of the second kind: give it one of its own.
        gamma (float, optional): discount per base step. Default: that of the env's
            ``OptionTransform``, else 0.99.
        tree_policy: :class:`UCT` (default, ``c=1``), :class:`PUCT`, :class:`Gumbel`,
            :class:`TorchRLScore`, or a callable over :class:`NodeStatistics`.
        novelty (NoveltyTest, optional): which new nodes are worth searching, e.g.
            ``RadiusNovelty("position", 0.35)``. Default: all.
        transpositions (Transpositions, optional): which states are the same. Default: none are.
        chance (ProgressiveWidening, optional): for a stochastic simulator, how often an option is
            simulated in a node. Default: once.
        leaf_evaluator (callable, optional): ``leaf_evaluator(td) -> values [m]`` or ``[m, 1]`` of
            new nodes, from their state and observation: :class:`ValueEvaluator`,
            :class:`RolloutEvaluator`, :class:`MixedEvaluator` or your own. Default: 0.
        option_prior (callable, optional): ``option_prior(td) -> probabilities [m, A]``:
            :class:`ModulePrior` or your own. Default: uniform.
        rollout (TreeRollout, optional): from every new leaf go on for some options and keep them in
            the tree. Needs ``expand="one"``. Default: none.
        root_noise (DirichletNoise, optional): noise in the prior of the roots. Default: none.
        backup: :class:`MeanBackup` (default) or :class:`MaxBackup`.
        final_choice: :class:`BestPlan`, :class:`MostVisited`, :class:`HighestValue` or
            :class:`SampledVisits`. Default: best plan; with ``chance`` most visited, since no
            sequence of options is sure to repeat; with :class:`Gumbel` its own choice.
        budget (SearchBudget): limits per root. Default: 1,000 expansions, until a plan is found.
        expand: ``"all"`` simulates every option of a leaf at once (default), ``"one"`` only the
            option that the tree policy chooses, as in the textbook.
        leaves_per_wave (int): leaves of each root that share a simulator call. More are faster for
            few roots and search less selectively. At most 255; default 1.
        exhausted: what a descent does with an option behind which nothing is left to simulate:
            ``"skip"`` it (default: every simulation finds something new), or ``"revisit"`` it and
            back its known value up once more, at no simulator's cost, so that visits and mean
            values are those of the textbook. Always ``"revisit"`` with ``chance`` or ``Gumbel``.
        duration_key, mask_key (NestedKey): entries of the env with the base steps of a step, int64
            ``[*B, 1]`` (1 if the env has none), and the options that may be taken, bool ``[*B,
            A]`` (all if it has none).
        reward_key (NestedKey, optional): which reward, if the env has several.
        seed (int, optional): of the planner's random numbers; every call moves on from it. Default:
            drawn from torch's global generator when first needed.
        progress (callable, optional): called with a :class:`SearchProgress` after every wave.

    Writes: the env's action (the option), and ``"plan_found"`` (bool ``[*B, 1]``), ``"root_value"``
    (float ``[*B, 1]``), ``"root_visits"`` (int64 ``[*B, A]``), ``"num_simulations"``,
    ``"num_expansions"`` and ``"num_simulated_steps"`` (int64 ``[*B, 1]``).

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
        transpositions: Transpositions | None = None,
        chance: ProgressiveWidening | None = None,
        leaf_evaluator: Evaluator | None = None,
        option_prior: Evaluator | None = None,
        rollout: TreeRollout | None = None,
        root_noise: DirichletNoise | None = None,
        backup: Backup | None = None,
        final_choice: FinalChoice | None = None,
        budget: SearchBudget | None = None,
        expand: Literal["all", "one"] = "all",
        leaves_per_wave: int = 1,
        exhausted: Literal["skip", "revisit"] = "skip",
        duration_key: NestedKey = "duration",
        mask_key: NestedKey = "action_mask",
        reward_key: NestedKey | None = None,
        seed: int | None = None,
        progress: Callable[[SearchProgress], None] | None = None,
    ) -> None:
        super().__init__()
        if gamma is None:
            gamma = _option_gamma(env)
        if not 0.0 < gamma <= 1.0:
            raise ValueError(f"MCTSPlanner needs a discount gamma in (0, 1]; got {gamma}.")
        tree_policy = UCT() if tree_policy is None else tree_policy
        budget = SearchBudget() if budget is None else budget
        check_search(
            "MCTSPlanner",
            tree_policy=tree_policy,
            num_simulations=budget.simulations,
            expand=expand,
            leaves_per_wave=leaves_per_wave,
            exhausted=exhausted,
        )
        if rollout is not None and (expand != "one" or isinstance(tree_policy, Gumbel)):
            raise ValueError(
                f"MCTSPlanner: a TreeRollout goes on from the one option that was simulated; got "
                f"expand={expand!r} and tree_policy={tree_policy!r}. Pass expand='one' and UCT, "
                f"PUCT or a policy of your own."
            )
        if chance is not None and transpositions is not None:
            raise ValueError(
                "MCTSPlanner: transpositions share what follows a state, which chance redraws; "
                "leave one of the two out."
            )
        extra = []
        for part in (novelty, transpositions, leaf_evaluator, option_prior):
            extra += [unravel_key(k) for k in getattr(part, "in_keys", ())]
        self.simulator = Simulator(
            env,
            extra_keys=extra,
            duration_key=duration_key,
            mask_key=mask_key,
            reward_key=reward_key,
        )
        self.gamma = gamma
        self.tree_policy = tree_policy
        self.novelty = novelty
        self.transpositions = transpositions
        self.chance = chance
        # Not sub-modules: training or moving the planner must not change its owner's networks.
        self.__dict__["leaf_evaluator"] = leaf_evaluator
        self.__dict__["option_prior"] = option_prior
        for part in (leaf_evaluator, option_prior):
            bind = getattr(part, "bind", None)
            if bind is not None:
                bind(self.simulator, gamma)
        self.rollout = rollout
        self.root_noise = root_noise
        self.backup = MeanBackup() if backup is None else backup
        if final_choice is None:
            final_choice = BestPlan() if chance is None else MostVisited()
            self._gumbel_choice = isinstance(tree_policy, Gumbel)
        else:
            self._gumbel_choice = False
        self.final_choice = final_choice
        self.budget = budget
        self.expand = expand
        self.leaves_per_wave = leaves_per_wave
        self.exhausted = exhausted
        self.progress = progress
        self._seeds = None if seed is None else np.random.SeedSequence(seed)
        self.option_key = self.simulator.option_key
        self.num_options = self.simulator.num_options
        self.in_keys = list(self.simulator.root_keys)
        self.out_keys = [
            self.option_key,
            "plan_found",
            "root_value",
            "root_visits",
            "num_simulations",
            "num_expansions",
            "num_simulated_steps",
        ]
        self.last_search: Search | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Search from every state of the tensordict and write the options to take."""
        search = self.search(tensordict)
        shape = tensordict.batch_size
        device = self.simulator.env.device
        option = self.simulator.encode(torch.from_numpy(self.choose(search)).view(shape))
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
            "num_simulations": column(search.num_simulations),
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

    def search(self, td: TensorDictBase, *, seed: int | None = None) -> Search:
        """Search from every state of ``td`` (any batch shape, flattened) and return the trees.

        While it runs, and after an interruption, ``last_search`` holds what was found so far.
        """
        begin = time.perf_counter()
        search = self.plant(td, seed=seed)
        return self._grow(search, begin, np.arange(search.num_roots))

    def plant(self, td: TensorDictBase, *, seed: int | None = None) -> Search:
        """Plant a tree at every state of ``td``; nothing is simulated until :meth:`resume`."""
        root = self.simulator.root(td)
        num_roots = root.batch_size[0]
        search = Search(
            num_roots,
            self.num_options,
            tree_policy=self.tree_policy,
            backup=self.backup,
            novelty=self.novelty,
            transpositions=self.transpositions,
            chance=self.chance,
            expand=self.expand,
            leaves_per_wave=self.leaves_per_wave,
            exhausted=self.exhausted,
            capacity=self._capacity(num_roots),
        )
        self._seed(search, seed)
        self._plant(search, root, None)
        self.last_search = search
        return search

    def _capacity(self, num_roots: int) -> int:
        """Nodes to make room for at once: all that the budget allows, if that is not very many."""
        budget = self.budget
        limits = [x for x in (budget.simulations, budget.nodes) if x is not None]
        per_wave = self.leaves_per_wave * self.num_options
        if not limits or num_roots * min(limits) > 2**20:
            return 64
        return min(limits) + per_wave + 1

    def resume(self, search: Search, *, where: Tensor | None = None) -> Search:
        """Go on with a search, with a fresh budget; with ``Gumbel`` to the end of its schedule.

        Only the roots ``where`` (bool ``[*B]``) are searched, all by default.
        """
        return self._grow(search, time.perf_counter(), _rows(search, where))

    def advance(
        self,
        search: Search,
        options: Tensor,
        td: TensorDictBase,
        *,
        where: Tensor | None = None,
        seed: int | None = None,
    ) -> Tensor:
        """Move the roots of a search along: ``options`` were carried out and led to ``td``.

        Where an outcome of the options in the tree is the state in ``td``, bit for bit, its subtree
        is kept; elsewhere a new tree is planted. Nothing is simulated until :meth:`resume`.

        Args:
            search: as :meth:`search` returned it.
            options: int64 ``[*B]``, or ``[*B, k]`` for several one after the other, with -1 behind
                the last; -1 alone for a new tree.
            td: states ``[*B]`` after the options.
            where: bool ``[*B]``, the roots to move; the others stay as they are. Default: all.
            seed: as in :meth:`search`.

        Returns:
            Which subtrees were kept, bool ``[*B]``.

        Raises:
            ValueError: if the options or states do not fit the search.
        """
        shape = td.batch_size
        if shape.numel() != search.num_roots or options.shape[: len(shape)] != shape:
            raise ValueError(
                f"advance needs options and a state for each of the {search.num_roots} roots of "
                f"the search; got options {list(options.shape)} and states {list(shape)}."
            )
        if options.ndim > len(shape) + 1:
            raise ValueError(
                f"advance needs options [*B] or [*B, k] with *B = {list(shape)}; got "
                f"{list(options.shape)}."
            )
        if options.numel() and int(options.max()) >= self.num_options:
            raise ValueError(
                f"advance needs options below {self.num_options}; got {int(options.max())}."
            )
        rows = _rows(search, where)
        if not len(rows):
            return torch.zeros(shape, dtype=torch.bool)
        index = torch.from_numpy(rows)
        root = self.simulator.root(td.reshape(-1)[index])
        taken = options.reshape(search.num_roots, -1)[index].tolist()
        state, done = self.simulator.state(root), self.simulator.done(root)
        kept = np.zeros(search.num_roots, np.bool_)
        self._seed(search, seed)
        reuse = not isinstance(self.tree_policy, Gumbel)  # halving starts from zero visits
        for i, b in enumerate(rows.tolist()):
            path = [option for option in taken[i] if option >= 0]
            node = self._find_outcome(search, b, path, state[i], done[i]) if path and reuse else -1
            if node >= 0:
                search.reroot(b, node)
                kept[b] = True
        fresh = np.flatnonzero(~kept[rows])
        if len(fresh):
            self._plant(search, root[torch.from_numpy(fresh)], rows[fresh])
        if self.root_noise is not None and kept.any():
            search.add_noise(self.root_noise, np.flatnonzero(kept))
        self.last_search = search
        return torch.from_numpy(kept).view(shape)

    def _find_outcome(
        self, search: Search, b: int, path: list[int], state: TensorDictBase, done: bool
    ) -> int:
        """The outcome of the options ``path`` of root ``b`` with exactly this state, or -1."""
        states, nodes = search.tree.states, search.tree.nodes[b]
        assert states is not None
        reached = [0]
        for option in path:
            outcomes = [n for above in reached for n in search.outcomes_of(b, option, above)]
            twins = [int(nodes["twin"][n]) for n in outcomes]  # where an equal state is searched
            reached = [t if t >= 0 else n for n, t in zip(outcomes, twins, strict=True)]
        for node in reached:
            if bool(nodes["flags"][node] & TERMINAL) == done and all(
                torch.equal(states.get(key)[b, node], state.get(key))
                for key in self.simulator.state_keys
            ):
                return node
        return -1

    def _seed(self, search: Search, seed: int | None) -> None:
        if seed is None:
            if self._seeds is None:
                self._seeds = np.random.SeedSequence(
                    int(torch.empty((), dtype=torch.int64).random_())
                )
            seed = int(self._seeds.spawn(1)[0].generate_state(1, np.uint32)[0])
        search.seed((np.arange(search.num_roots) + int(seed)) & np.iinfo(np.int64).max)

    def _plant(self, search: Search, root: TensorDictBase, rows: np.ndarray | None) -> None:
        """Plant the roots ``rows`` of a search, all by default, at the states ``root``."""
        simulator = self.simulator
        where = np.arange(search.num_roots) if rows is None else rows
        with torch.no_grad():
            done = simulator.done(root)
            masks = simulator.masks(root)
            if len(masks) and not (masks.any(-1) | done).all():
                bad = int(where[np.flatnonzero(~(masks.any(-1) | done))[0]])
                raise ValueError(
                    f"Root {bad} has no option that may be taken: its action mask is all False. "
                    f"Plan from a state that is not a dead end, or mark it as done."
                )
            values = self._evaluate(root, simulator.terminated(root), lambda: search.seeds[where])
            known = RootStates(
                values=values,
                done=done,
                priors=self._priors(root),
                masks=masks,
                features=self._features(root),
                codes=self._codes(root),
            )
        search.start(known, rows)
        search.tree.set_states(where, np.zeros_like(where), simulator.state(root))
        if self.root_noise is not None:
            search.add_noise(self.root_noise, where)

    @torch.no_grad()
    def _grow(self, search: Search, begin: float, rows: np.ndarray) -> Search:
        budget = self.budget
        search.begin(budget.simulations)
        if isinstance(self.tree_policy, Gumbel):
            assert budget.simulations is not None
            search.halve(budget.simulations)
            # There is one schedule per search: after an interruption it goes on where it stood.
            search.roots["simulations"] = search.tree.edges["visits"][:, 0].sum(-1)
        # Without a limit of simulations a root may revisit what it knows for ever.
        endless = budget.simulations is None and bool(search.settings["revisit"][0])
        since = search.roots["revisits"].copy()  # at the last outcome of each root
        active = self._still_active(search, rows)
        while len(active):
            wave = search.select(active)
            if len(wave):
                self._simulate(search, wave)
            if self.rollout is not None:
                further = wave
                for _ in range(self.rollout.max_options):
                    further = search.extend(further)
                    if not len(further):
                        break
                    self._simulate(search, further)
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
                        search=search,
                    )
                )
            if budget.seconds is not None and seconds >= budget.seconds:
                break
            if endless:
                revisits = search.roots["revisits"]
                since[wave.roots] = revisits[wave.roots]
                active = active[revisits[active] - since[active] < _MAX_FRUITLESS_REVISITS]
            active = self._still_active(search, active)
        for root in rows[search.exhausted(rows)]:
            search.solve(int(root))
        return search

    def _still_active(self, search: Search, active: np.ndarray) -> np.ndarray:
        """The roots among ``active`` that have budget left and something to simulate."""
        budget = self.budget
        kept, stuck = np.empty_like(active), np.empty_like(active)
        num_kept, num_stuck = search._kernels.still_active(
            search.tree.nodes,
            search.tree.roots,
            active,
            NO_LIMIT if budget.expansions is None else budget.expansions,
            NO_LIMIT if budget.base_steps is None else budget.base_steps,
            NO_LIMIT if budget.nodes is None else budget.nodes,
            budget.until_plan,
            budget.improve_expansions,
            kept,
            stuck,
        )
        if not num_stuck:
            return kept[:num_kept]
        revisits = search.revisits_exhausted
        opened = [b for b in stuck[:num_stuck].tolist() if search.relax(b) or revisits]
        return np.sort(np.concatenate((kept[:num_kept], np.array(opened, np.int64))))

    def _simulate(self, search: Search, wave: Wave) -> None:
        try:
            self._insert(search, wave)
        except BaseException:
            search.cancel(wave)
            raise

    def _insert(self, search: Search, wave: Wave) -> None:
        simulator, tree = self.simulator, search.tree
        states = tree.get_states(wave.roots, wave.nodes, simulator.state_keys)
        after = simulator.step(states, wave.options)
        terminated, done = simulator.terminated(after), simulator.done(after)
        durations = simulator.durations(after)
        if simulator.duration_key is None:
            discounts = np.where(terminated, np.float32(0.0), np.float32(self.gamma))
        else:
            discounts = np.where(terminated, 0.0, self.gamma**durations).astype(np.float32)
        outcomes = Outcomes(
            rewards=simulator.rewards(after),
            discounts=discounts,
            durations=durations,
            done=done,
            values=self._evaluate(after, terminated, lambda: _row_seeds(search, wave)),
            priors=self._priors(after),
            masks=simulator.masks(after),
            features=self._features(after),
            codes=self._codes(after),
        )
        merges = None
        if self.chance is not None:
            merges = self._find_merges(search, wave, after, done)
        nodes = search.insert(wave, outcomes, merges)
        tree.set_states(wave.roots, nodes, after)

    def _find_merges(
        self, search: Search, wave: Wave, after: TensorDictBase, done: np.ndarray
    ) -> np.ndarray:
        """Known outcomes of the same option with the same state, or -1, int64 ``[m]``."""
        tree, keys = search.tree, self.simulator.state_keys
        merges = np.full(len(wave), -1, np.int64)
        assert tree.states is not None
        first = tree.edges["child"][wave.roots, wave.nodes, wave.options]
        for i in np.flatnonzero(first >= 0).tolist():
            b, node = wave.roots[i], int(first[i])
            while node >= 0:
                if bool(tree.nodes["flags"][b, node] & TERMINAL) == done[i] and all(
                    torch.equal(tree.states.get(key)[b, node], after.get(key)[i]) for key in keys
                ):
                    merges[i] = node
                    break
                node = int(tree.nodes["sibling"][b, node])
        return merges

    def _evaluate(
        self, td: TensorDictBase, terminated: np.ndarray, seeds: Callable[[], np.ndarray]
    ) -> np.ndarray:
        if self.leaf_evaluator is None:
            return np.zeros(td.batch_size[0], np.float32)
        if getattr(self.leaf_evaluator, "is_random", False):
            td = td.copy().set(SEED_KEY, torch.from_numpy(seeds()))
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

    def _codes(self, td: TensorDictBase) -> np.ndarray | None:
        return None if self.transpositions is None else self.transpositions.codes(td)

    def choose(self, search: Search) -> np.ndarray:
        """Return the option to take in each root of a search, int64 ``[B]``."""
        return search.gumbel_choice() if self._gumbel_choice else self.final_choice.choose(search)

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


def _row_seeds(search: Search, wave: Wave) -> np.ndarray:
    """A seed for each outcome that depends on its root, node, option and order, int64 ``[m]``."""
    mixed = search.seeds[wave.roots].astype(np.uint64) * np.uint64(0xBF58476D1CE4E5B9)
    counted = search.num_simulations[wave.roots]
    for part in (wave.nodes, wave.options, counted):
        mixed = (mixed ^ part.astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return (mixed >> np.uint64(1)).astype(np.int64)


def _as_tensor(value: Tensor, name: str) -> Tensor:
    if not isinstance(value, Tensor):
        raise TypeError(
            f"{name} must return a tensor; got {type(value).__name__}. Wrap a TensorDictModule as "
            f'lambda td: module(td)["state_value"].'
        )
    return value


def _option_gamma(env: EnvBase) -> float:
    """The discount of the env's last OptionTransform, or of an env with options; else 0.99."""
    transform = getattr(env, "transform", None)
    transforms = transform if isinstance(transform, Compose) else [transform]
    for candidate in (*reversed(list(transforms)), getattr(env, "base_env", env)):
        gamma = getattr(candidate, "gamma", None)
        if gamma is not None and hasattr(candidate, "num_options"):
            return float(gamma)
    return 0.99
