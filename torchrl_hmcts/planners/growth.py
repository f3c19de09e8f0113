"""How trees grow: waves of leaves go to the simulator, their outcomes into the trees.

The loop of the search. What a wave is and how outcomes are backed up is in
:mod:`~torchrl_hmcts.planners.search`; how a state is set and an option taken, in
:mod:`~torchrl_hmcts.planners.simulator`.

Letters: B roots, m outcomes of one wave.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_hmcts.checks import NO_LIMIT
from torchrl_hmcts.planners.node_evaluation import (
    leaf_values,
    node_codes,
    node_features,
    option_priors,
)
from torchrl_hmcts.planners.search import Outcomes, Search, Wave
from torchrl_hmcts.planners.tree import MOST_BASE_STEPS, TERMINAL
from torchrl_hmcts.planners.tree_policies import Gumbel

if TYPE_CHECKING:
    from torchrl_hmcts.planners.mcts import MCTSPlanner

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


@dataclass(slots=True)
class _UnderWay:
    """A wave that is being simulated."""

    wave: Wave
    sent: Any  # what the simulator gave for it
    roots: np.ndarray  # of the leaves from which its rollouts began
    depth: int  # options of the rollouts before this one
    received: bool = False


class Growth:
    """Grows the trees of a search until the budget of its planner is spent.

    Up to ``waves_in_flight`` waves are under way. The one that was sent first is waited for, its
    outcomes are inserted, its rollouts go on or a new wave is selected in its place.

    Args:
        planner: gives the simulator, the budget and what new nodes are asked for.
        search: the trees.
    """

    def __init__(self, planner: MCTSPlanner, search: Search) -> None:
        self.planner, self.search, self.simulator = planner, search, planner.simulator
        self._rollout_options = 0 if planner.rollout is None else planner.rollout.max_options
        self._under_way: deque[_UnderWay] = deque()

    @torch.no_grad()
    def run(self, begin: float, rows: np.ndarray) -> Search:
        """Grow trees and return the search.

        Args:
            begin: when the call began, in seconds of ``time.perf_counter()``.
            rows: the roots whose trees grow, int64.

        Raises:
            RuntimeError: if an earlier run was interrupted while it inserted outcomes.
        """
        search, budget = self.search, self.planner.budget
        search.begin(budget.simulations)
        search.growing = search.num_roots > 0
        if isinstance(self.planner.tree_policy, Gumbel):
            assert budget.simulations is not None
            search.halve(budget.simulations)
            # There is one schedule per search: after an interruption it goes on where it stood.
            search.roots["simulations"] = search.tree.edges["visits"][:, 0].sum(-1)
        try:
            self._grow(begin, rows)
        except BaseException:
            for begun in self._under_way:
                search.cancel(begun.wave)
                if not begun.received:
                    self.simulator.abandon(begun.sent)
            raise
        search.growing = False
        for root in rows[search.exhausted(rows)]:
            search.solve(int(root))
        return search

    def _grow(self, begin: float, rows: np.ndarray) -> None:
        search, budget, under_way = self.search, self.planner.budget, self._under_way
        # Without a limit of simulations a root may revisit what it knows for ever.
        endless = bool(search.settings["revisit"][0]) and bool(
            (search.roots["limit"] == NO_LIMIT).any()
        )
        since = search.roots["revisits"].copy()  # at the last outcome of each root
        active = self._still_active(rows)
        while len(active) or under_way:
            while len(active) and len(under_way) < search.waves_in_flight:
                wave = search.select(active)
                if not len(wave):
                    break
                self._send(wave)
            if under_way:
                first = under_way[0]  # taken out once it is in the tree
                after = self.simulator.receive(first.sent)
                first.received = True
                self._insert(first.wave, after)
                under_way.popleft()
                if first.depth < self._rollout_options and self._extend(first):
                    continue
                if endless:
                    since[first.roots] = search.roots["revisits"][first.roots]
            seconds = time.perf_counter() - begin
            if self.planner.progress is not None:
                self.planner.progress(self._progress(len(active), seconds))
            if budget.seconds is not None and seconds >= budget.seconds:
                active = active[:0]
                continue
            if endless:
                revisits = search.roots["revisits"]
                active = active[revisits[active] - since[active] < _MAX_FRUITLESS_REVISITS]
            active = self._still_active(active)

    def _progress(self, num_active: int, seconds: float) -> SearchProgress:
        search = self.search
        return SearchProgress(
            num_roots=search.num_roots,
            num_active=num_active,
            num_found=int((search.best_node >= 0).sum()),
            expansions=int(search.num_expansions.sum()),
            base_steps=int(search.num_base_steps.sum()),
            seconds=seconds,
            search=search,
        )

    def _still_active(self, active: np.ndarray) -> np.ndarray:
        """The roots among ``active`` that have budget left and something to simulate."""
        search, budget = self.search, self.planner.budget
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

    # ---------------------------------------------------------------- a wave

    def _send(self, wave: Wave, begun: _UnderWay | None = None) -> None:
        """Have a wave simulated: leaves, or one option more of the rollouts ``begun``."""
        search, simulator = self.search, self.simulator
        if search.waves_in_flight > 1:
            wave = search.detach(wave)
        try:
            states = search.tree.get_states(wave.roots, wave.nodes, simulator.state_keys)
            sent = simulator.send(states, wave.options.copy())  # the env may write into them
            if search.waves_in_flight > 1 and not simulator.works_beside:
                sent = sent.clone()  # an env may write its next states into the same tensors
        except BaseException:
            search.cancel(wave)
            raise
        roots, depth = (wave.roots, 0) if begun is None else (begun.roots, begun.depth + 1)
        self._under_way.append(_UnderWay(wave, sent, roots, depth))

    def _extend(self, begun: _UnderWay) -> bool:
        """Have the rollouts of a wave that was inserted go on; return whether any does."""
        further = self.search.extend(begun.wave)
        if len(further):
            self._send(further, begun)
        return len(further) > 0

    def _insert(self, wave: Wave, after: TensorDictBase) -> None:
        planner, search, simulator = self.planner, self.search, self.simulator
        terminated, done = simulator.terminated(after), simulator.done(after)
        durations = simulator.durations(after)
        if simulator.duration_key is None:
            discounts = np.where(terminated, np.float32(0.0), np.float32(planner.gamma))
        else:
            _check_durations(search, wave, durations)
            discounts = np.where(terminated, 0.0, planner.gamma**durations).astype(np.float32)
        looked_at = after
        if planner.leaf_evaluator is not None or planner.option_prior is not None:
            looked_at = after.clone()  # what is stored must not depend on what they do with it
        outcomes = Outcomes(
            rewards=simulator.rewards(after),
            discounts=discounts,
            durations=durations,
            done=done,
            values=leaf_values(
                planner.leaf_evaluator, looked_at, terminated, lambda: _row_seeds(search, wave)
            ),
            priors=option_priors(planner.option_prior, looked_at, planner.num_options),
            masks=simulator.masks(after),
            features=node_features(planner.novelty, after),
            codes=node_codes(planner.transpositions, after),
        )
        merges = None
        if planner.chance is not None:
            merges = self._find_merges(wave, after, done)
        nodes = search.insert(wave, outcomes, merges)
        search.tree.set_states(wave.roots, nodes, after)
        search.inserting = False

    def _find_merges(self, wave: Wave, after: TensorDictBase, done: np.ndarray) -> np.ndarray:
        """Known outcomes of the same option with the same state, or -1, int64 ``[m]``."""
        tree, keys = self.search.tree, self.simulator.state_keys
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


def _check_durations(search: Search, wave: Wave, durations: np.ndarray) -> None:
    """Refuse times that no option can have taken, and paths whose length would wrap."""
    above = search.tree.nodes["base_steps"][wave.roots, wave.nodes]
    good = (durations >= 1) & (durations <= MOST_BASE_STEPS - above.astype(np.int64))
    if not good.all():
        raise ValueError(
            f"The simulator returned a duration of {durations[~good][0]}. An option takes one base "
            f"step or more, and a path {MOST_BASE_STEPS:,} at most; find the step from which the "
            f"env wrote it."
        )


def _row_seeds(search: Search, wave: Wave) -> np.ndarray:
    """A seed for each outcome that depends on its root, node, option and order, int64 ``[m]``."""
    mixed = search.seeds[wave.roots].astype(np.uint64) * np.uint64(0xBF58476D1CE4E5B9)
    counted = search.num_simulations[wave.roots]
    for part in (wave.nodes, wave.options, counted):
        mixed = (mixed ^ part.astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return (mixed >> np.uint64(1)).astype(np.int64)
