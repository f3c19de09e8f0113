"""The search itself, on arrays: a wave is :meth:`Search.select`, its simulation by whoever runs the
search, and :meth:`Search.insert`. Nothing here knows tensordicts or environments.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from torchrl_hmcts.checks import NO_LIMIT, instance, whole_number
from torchrl_hmcts.planners.budget import SearchBudget
from torchrl_hmcts.planners.novelty import ask
from torchrl_hmcts.planners.outcomes import Outcomes, RootStates, check_rows, refuse
from torchrl_hmcts.planners.scored_descent import select_by_scores
from torchrl_hmcts.planners.settings import SearchSettings
from torchrl_hmcts.planners.tree import (
    CLOSED,
    FORBIDDEN,
    MANY_ROOTS,
    PENDING,
    PRUNED,
    REWARDED,
    WAVE,
)
from torchrl_hmcts.planners.tree_policies import CompiledPolicy
from torchrl_hmcts.planners.tree_view import SearchTree


class Wave:
    """Triples to simulate next: take ``options[i]`` in node ``nodes[i]`` of root ``roots[i]``."""

    def __init__(self, records: np.ndarray, *, detached: bool = False) -> None:
        self.records = records  # [m] of tree.WAVE
        self.detached = detached  # others may be selected before it is inserted
        self.roots = records["root"].copy()  # [m] int64
        self.nodes = records["node"].copy()  # [m] int64
        self.options = records["option"].copy()  # [m] int64

    def __len__(self) -> int:
        return len(self.records)


def _counter(name: str, meaning: str) -> Any:
    """A property of a search: one number of each root."""
    return property(lambda search: search.tree.roots[name], doc=f"{meaning}, ``[B]``.")


class Search:
    """The trees of ``B`` roots under one :class:`SearchSettings`.

    Args:
        num_roots: B.
        num_options: A.
        settings: what it is set to. Default: ``SearchSettings()``.
        capacity: nodes per root to make room for at first.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> search = MCTSPlanner(env).search(env.reset())
        >>> search.tree.options(root=0, node=search.best_node[0])
        [1, 1, 1]
    """

    def __init__(
        self,
        num_roots: int,
        num_options: int,
        settings: SearchSettings | None = None,
        *,
        capacity: int = 64,
    ) -> None:
        from torchrl_hmcts.planners import kernels, root_kernels

        self._kernels, self._root_kernels = kernels, root_kernels
        settings = SearchSettings() if settings is None else settings
        instance("Search", "settings", settings, SearchSettings)
        self.tree = SearchTree(num_roots, num_options, capacity=capacity)
        self.num_roots, self.num_options = self.tree.num_roots, self.tree.num_options
        # Copies: what one search has seen is nothing to the next, nor to one that is resumed later.
        self.novelty = copy.copy(settings.novelty)
        self.transpositions = copy.copy(settings.transpositions)
        self.inserting = False  # also after an interruption: nodes may be there without a state
        self.growing = False  # also after an interruption: some of it may have been in flight
        self.follow(settings)
        self.gumbel = np.zeros((0, 0), np.float32)  # [B, A + N], see root_options.halve
        self.seeds = np.arange(self.num_roots)  # [B]
        self.rollouts: dict[int, np.random.Generator] = {}
        self._room = 1  # nodes of the largest tree, at most
        self._root_kernels.limit(self.tree.roots, NO_LIMIT)

    def __repr__(self) -> str:
        plans = int((self.best_node >= 0).sum())
        return f"Search({self.tree!r}, plans of {plans} of {self.num_roots} roots)"

    def _repr_html_(self) -> str:
        return self.tree._repr_html_()

    def __getstate__(self) -> dict[str, Any]:  # a module can be neither copied nor sent
        return {**self.__dict__, "_kernels": None, "_root_kernels": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        from torchrl_hmcts.planners import kernels, root_kernels

        self.__dict__.update(state, _kernels=kernels, _root_kernels=root_kernels)

    def follow(self, settings: SearchSettings) -> None:
        """Take over settings, of which those that shape the tree are as before."""
        self.settings, self.record = settings, settings.record()
        policy = settings.tree_policy
        self._scores = None if isinstance(policy, CompiledPolicy) else policy
        if self._scores is None:
            self._kernels.fill_factors(self.record)
        self._per_root = settings.leaves_per_wave
        self._per_root *= self.num_options if settings.expand == "all" else 1
        self._wave = np.zeros(self.num_roots * self._per_root, WAVE)

    # ------------------------------------------------------------------ what is known of the roots

    roots = property(lambda search: search.tree.roots, doc="Counters, ``[B]`` of ``tree.ROOT``.")
    num_simulations = _counter("simulations", "Options simulated or revisited since :meth:`limit`")
    num_expansions = _counter("expansions", "Expansions since :meth:`limit`")
    num_base_steps = _counter("base_steps", "Base steps simulated since :meth:`limit`")
    best_node = _counter("best_node", "End of the best plan so far, -1 without one")
    best_return = _counter("best_return", "Discounted return of the best plan, -inf without one")
    expansions_to_plan = _counter("expansions_to_plan", "Expansions when the first plan was found")
    base_steps_to_plan = _counter("base_steps_to_plan", "Base steps when the first plan was found")

    # ------------------------------------------------------------------ growing

    def plant(self, known: RootStates, rows: np.ndarray | None = None) -> None:
        """Plant the roots ``rows`` (all by default), one for each row of ``known``."""
        first = rows is None
        if rows is None:
            rows = np.arange(self.num_roots)
        check_rows(known, len(rows), self.num_options)
        if len(rows) and not (0 <= rows.min() and rows.max() < self.num_roots):
            raise ValueError(f"A search of {self.num_roots} roots has no roots {rows}.")
        tree = self.tree
        for test in (self.novelty, self.transpositions):
            if test is not None and first:
                test.start(self.num_roots)
            elif test is not None:
                for root in rows:
                    test.restart(int(root))
        if first:
            shape = (self.num_roots, tree.capacity)
            if known.features is not None:
                width, dtype = known.features.shape[1], known.features.dtype
                tree.features = np.zeros((*shape, width), dtype)
            if known.codes is not None:
                tree.codes = np.zeros((*shape, known.codes.shape[1]), np.uint8)
        self._root_kernels.add_roots(
            tree.nodes, tree.edges, tree.roots, rows, known.values, known.done, known.priors,
            known.masks,
        )  # fmt: skip
        zeros = np.zeros(len(rows), np.int64)
        tree.remember(rows, zeros, known.features, known.codes)
        if self.novelty is not None and known.features is not None:
            self.novelty.accept(rows.copy(), known.features.copy(), zeros.copy())
        if self.transpositions is not None and known.codes is not None:
            self.transpositions.find(rows, known.codes, zeros)

    def limit(self, num_simulations: int | None = None) -> None:
        """Count simulations, expansions and base steps from 0, up to a number of simulations.

        What an interruption left in flight is forgotten.

        Raises:
            RuntimeError: if the interruption came while outcomes were inserted.
        """
        if self.inserting:
            raise RuntimeError(
                "This search was interrupted while outcomes were inserted: it may have nodes "
                "without a state, and cannot continue. Its plans and values can be read; search "
                "again to continue."
            )
        if self.growing:
            self._forget_in_flight()
            self.roots["scheduled"] = 0
            self.growing = False
        limit = NO_LIMIT if num_simulations is None else num_simulations
        self._root_kernels.limit(self.roots, limit)

    def _forget_in_flight(self) -> None:
        self.tree.edges["in_flight"] = 0
        self.tree.nodes["flags"] &= ~PENDING

    def select(self, active: np.ndarray | None = None) -> Wave:
        """Choose the options to simulate for the roots ``active`` (all that are, by default).

        A root that is exhausted or has spent its simulations adds none.
        """
        tree = self.tree
        if active is not None:
            tree.roots["active"] = 0
            tree.roots["active"][active] = 1
        if self._scores is not None:
            try:
                count = select_by_scores(tree, self.settings, self.record, self._wave)
            except BaseException:  # e.g. a policy that raises: forget the half-made wave
                self._forget_in_flight()
                raise
            return Wave(self._wave[:count])
        walked = False
        if self.num_roots >= MANY_ROOTS:
            from torchrl_hmcts.planners.batch_kernels import walk

            walked = walk(tree.nodes, tree.edges, tree.roots, self.record, self.gumbel)
        count = self._kernels.select(
            tree.nodes, tree.edges, tree.roots, self.record, self.gumbel, self._wave, walked
        )
        return Wave(self._wave[:count])

    def detach(self, wave: Wave) -> Wave:
        """Return a wave before whose insertion others can be selected.

        Until it is inserted or cancelled its simulations count as spent.
        """
        np.add.at(self.roots["scheduled"], wave.roots, 1)
        return Wave(wave.records.copy(), detached=True)

    def _attach(self, wave: Wave) -> None:
        if wave.detached:
            np.subtract.at(self.roots["scheduled"], wave.roots, 1)
            wave.detached = False

    def cancel(self, wave: Wave) -> None:
        """Take a wave back that will not be inserted, e.g. after an error in the simulator."""
        self._attach(wave)
        self._kernels.cancel(self.tree.nodes, self.tree.edges, self.record, wave.records)

    def insert(
        self, wave: Wave, outcomes: Outcomes, merges: np.ndarray | None = None
    ) -> np.ndarray:
        """Append the outcomes of a wave and back them up; return their nodes, int64 ``[m]``.

        ``merges`` (int64 ``[m]``) names the outcome of the same option that has the same state, or
        -1; only in a stochastic simulator.
        """
        tree, m = self.tree, len(wave)
        if merges is not None and not (
            len(merges) == m and (merges < tree.num_nodes[wave.records["root"]]).all()
        ):
            raise ValueError(f"merges must name {m} nodes of the tree, or -1; got {merges}.")
        novel, twins = np.ones(m, np.bool_), np.empty(0, np.int64)
        if self.transpositions is not None or self.novelty is not None:
            check_rows(outcomes, m, self.num_options)
            numbers = outcomes.rewards, outcomes.discounts, outcomes.values, outcomes.priors
            refuse(outcomes, self._kernels.first_bad(*numbers))
            novel, twins = self._look_up(wave, outcomes)
        self._attach(wave)
        self._reserve_wave()
        self.inserting = tree.states is not None  # until the new states are stored, too
        status = self._kernels.insert(
            tree.nodes, tree.edges, tree.roots, self.record, wave.records, outcomes.rewards,
            outcomes.discounts, outcomes.durations, outcomes.done, novel, twins,
            np.empty(0, np.int64) if merges is None else merges, outcomes.values, outcomes.priors,
            outcomes.masks,
        )  # fmt: skip
        if status != self._kernels.GOOD:
            self.inserting = False
            check_rows(outcomes, m, self.num_options)
            refuse(outcomes, status)
        new_nodes = wave.records["new_node"].copy()
        tree.remember(wave.roots, new_nodes, outcomes.features, outcomes.codes)
        return new_nodes

    def _look_up(self, wave: Wave, outcomes: Outcomes) -> tuple[np.ndarray, np.ndarray]:
        """Which states are novel, bool ``[m]``, and their twins, int64 ``[m]`` or ``[0]``."""
        tree, m = self.tree, len(wave)
        novel, twins = np.ones(m, np.bool_), np.empty(0, np.int64)
        further = np.flatnonzero(~outcomes.done)
        if self.transpositions is not None:
            from torchrl_hmcts.planners.variant_kernels import number_nodes

            assert outcomes.codes is not None
            twins = np.full(m, -1, np.int64)
            nodes = number_nodes(tree.roots, wave.roots)[further]
            roots = wave.roots[further]
            twins[further] = self.transpositions.find(roots, outcomes.codes[further], nodes)
            further = further[twins[further] < 0]
        if self.novelty is not None:
            assert outcomes.features is not None
            steps = tree.nodes["base_steps"][wave.roots, wave.nodes] + outcomes.durations
            features = outcomes.features[further]
            novel[further] = ask(self.novelty, wave.roots[further], features, steps[further])
        return novel, twins

    def _reserve_wave(self) -> None:
        """Make room for the nodes of one wave."""
        if self._room + self._per_root > self.tree.capacity:
            self._room = int(self.tree.num_nodes.max(initial=1))
            self.tree.reserve(self._room + self._per_root)
        self._room += self._per_root

    def seed(self, seed: int) -> None:
        """Let root ``b`` draw its random numbers from ``seed + b``, modulo 2 ** 63."""
        whole_number("A search", "seed", seed)
        seeds = np.arange(self.num_roots, dtype=np.uint64) + np.uint64(int(seed) & NO_LIMIT)
        self.seeds = (seeds & np.uint64(NO_LIMIT)).astype(np.int64)
        self.rollouts = {}

    def generator(self, root: int, purpose: str) -> np.random.Generator:
        """Return random numbers that depend on the root's seed and on what they are for."""
        return np.random.default_rng([int(self.seeds[root]), *purpose.encode()])

    def exhausted(self, roots: np.ndarray) -> np.ndarray:
        """Return which of the roots have nothing left to simulate, bool ``[len(roots)]``."""
        return (self.tree.nodes["flags"][roots, 0] & CLOSED) != 0

    def still_active(
        self, active: np.ndarray, budget: SearchBudget
    ) -> tuple[np.ndarray, np.ndarray]:
        """Split roots, int64, into those that continue under a budget and those exhausted.

        A root whose budget is spent is neither.
        """
        kept, stuck = np.empty_like(active), np.empty_like(active)
        nodes, roots = self.tree.nodes, self.tree.roots
        num_kept, num_stuck = self._root_kernels.still_active(
            nodes, roots, active, *budget.limits, kept, stuck
        )
        return kept[:num_kept], stuck[:num_stuck]

    @property
    def revisits_exhausted(self) -> bool:
        """True if an exhausted root still spends its simulations on what it knows."""
        return self.settings.revisit and bool((self.roots["limit"] != NO_LIMIT).all())

    def allowed(self) -> np.ndarray:
        """Return the options that may be taken in the roots, bool ``[B, A]``."""
        allowed: np.ndarray = self.tree.edges["closed"][:, 0] != FORBIDDEN
        return allowed

    def statistics(self) -> dict[str, Any]:
        """Return counts of the whole search, for logs."""
        used = np.arange(self.tree.capacity) < self.tree.num_nodes[:, None]
        flags = self.tree.nodes["flags"]
        twins = self.tree.nodes["twin"] >= 0
        counts = {
            "nodes": int(self.tree.num_nodes.sum()),
            "pruned": int(((flags & PRUNED) != 0)[used].sum()),
            "transposed": int(twins[used].sum()) if self.transpositions is not None else 0,
            "rewarded": int(((flags & REWARDED) != 0)[used].sum()),
            "simulations": int(self.num_simulations.sum()),
            "revisits": int(self.roots["revisits"].sum()),
            "expansions": int(self.num_expansions.sum()),
            "base_steps": int(self.num_base_steps.sum()),
        }
        for test in (self.novelty, self.transpositions):
            if test is not None and hasattr(test, "statistics"):
                counts.update(test.statistics())
        return counts
