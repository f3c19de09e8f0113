"""The loop of a search: waves of leaves go to the simulator, their outcomes into the trees.

Letters: B roots, m outcomes of one wave.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_hmcts.checks import NO_LIMIT
from torchrl_hmcts.planners.budget import SearchBudget
from torchrl_hmcts.planners.evaluation import NodeEvaluator
from torchrl_hmcts.planners.outcomes import Outcomes, check_durations
from torchrl_hmcts.planners.plan import SearchProgress
from torchrl_hmcts.planners.random_streams import wave_seeds
from torchrl_hmcts.planners.root_options import halve
from torchrl_hmcts.planners.search import Search, Wave
from torchrl_hmcts.planners.simulator import Simulator
from torchrl_hmcts.planners.subtree import extend, find_merges, relax, solve

# Revisits in a row, without a limit of simulations, after which a root has nothing left to find.
_MAX_FRUITLESS_REVISITS = 10_000


@dataclass(slots=True)
class _UnderWay:
    """A wave that is being simulated."""

    wave: Wave
    sent: Any  # what the simulator gave for it
    roots: np.ndarray  # of the leaves from which its rollouts began
    depth: int  # options of the rollouts before this one
    received: bool = False


class SearchLoop:
    """Grows the trees of a search until a budget is spent, with several waves under way."""

    def __init__(
        self,
        search: Search,
        simulator: Simulator,
        evaluate: NodeEvaluator,
        *,
        gamma: float,
        budget: SearchBudget,
        progress: Callable[[SearchProgress], None] | None = None,
    ) -> None:
        self.search, self.simulator, self.evaluate = search, simulator, evaluate
        self.gamma, self.budget, self.progress = gamma, budget, progress
        self._waves = search.settings.waves_in_flight
        rollout = search.settings.rollout
        self._rollout_options = 0 if rollout is None else rollout.max_options
        self._under_way: deque[_UnderWay] = deque()

    @torch.no_grad()
    def run(self, begin: float, rows: np.ndarray) -> Search:
        """Grow the trees of the roots ``rows``; ``begin`` is when the call began, in seconds."""
        search = self.search
        search.limit(self.budget.simulations)
        search.growing = search.num_roots > 0
        if search.settings.is_gumbel:
            assert self.budget.simulations is not None
            halve(search, self.budget.simulations)
            # There is one schedule per search: after an interruption it continues where it stood.
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
            solve(search, int(root))
        return search

    def _grow(self, begin: float, rows: np.ndarray) -> None:
        search, budget, under_way = self.search, self.budget, self._under_way
        # Without a limit of simulations a root may revisit what it knows for ever.
        endless = search.settings.revisit and bool((search.roots["limit"] == NO_LIMIT).any())
        since = search.roots["revisits"].copy()  # at the last outcome of each root
        active = self._still_active(rows)
        while len(active) or under_way:
            while len(active) and len(under_way) < self._waves:
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
                if first.depth < self._rollout_options:
                    further = extend(search, first.wave)
                    if len(further):
                        self._send(further, first)
                        continue
                if endless:
                    since[first.roots] = search.roots["revisits"][first.roots]
            seconds = time.perf_counter() - begin
            if self.progress is not None:
                self.progress(self._progress(len(active), seconds))
            if budget.seconds is not None and seconds >= budget.seconds:
                active = active[:0]
                continue
            if endless:
                revisits = search.roots["revisits"]
                active = active[revisits[active] - since[active] < _MAX_FRUITLESS_REVISITS]
            active = self._still_active(active)

    def _progress(self, num_active: int, seconds: float) -> SearchProgress:
        search = self.search
        num_found, expansions = (search.best_node >= 0).sum(), search.num_expansions.sum()
        counts = search.num_roots, num_active, int(num_found), int(expansions)
        return SearchProgress(*counts, int(search.num_base_steps.sum()), seconds, search)

    def _still_active(self, active: np.ndarray) -> np.ndarray:
        """The roots among ``active`` that have budget left and something to simulate."""
        search, budget = self.search, self.budget
        kept, stuck = search.still_active(active, budget)
        if not len(stuck):
            return kept
        revisits = search.revisits_exhausted
        opened = [b for b in stuck.tolist() if relax(search, b) or revisits]
        return np.sort(np.concatenate((kept, np.array(opened, np.int64))))

    def _send(self, wave: Wave, begun: _UnderWay | None = None) -> None:
        """Have a wave simulated: leaves, or one option more of the rollouts ``begun``."""
        search, simulator = self.search, self.simulator
        if self._waves > 1:
            wave = search.detach(wave)
        try:
            states = search.tree.get_states(wave.roots, wave.nodes, simulator.state_keys)
            sent = simulator.send(states, wave.options)
            if self._waves > 1 and not simulator.works_beside:
                sent = sent.clone()  # an env may write its next states into the same tensors
        except BaseException:
            search.cancel(wave)
            raise
        roots, depth = (wave.roots, 0) if begun is None else (begun.roots, begun.depth + 1)
        self._under_way.append(_UnderWay(wave, sent, roots, depth))

    def _insert(self, wave: Wave, after: TensorDictBase) -> None:
        search, simulator, settings = self.search, self.simulator, self.search.settings
        terminated, durations = simulator.terminated(after), simulator.durations(after)
        if simulator.duration_key is None:
            discounts = np.where(terminated, np.float32(0.0), np.float32(self.gamma))
        else:
            above = search.tree.nodes["base_steps"][wave.roots, wave.nodes]
            check_durations(durations, above)
            discounts = np.where(terminated, 0.0, self.gamma**durations).astype(np.float32)

        def seeds() -> np.ndarray:
            options = wave.records["option"]  # the env may have written into wave.options
            counted = search.num_simulations[wave.roots]
            return wave_seeds(search.seeds[wave.roots], counted, wave.nodes, options)

        known = self.evaluate.describe(after, terminated, simulator, settings, seeds)
        outcomes = Outcomes(simulator.rewards(after), discounts, durations, *known)
        merges = None
        if settings.chance is not None:
            merges = find_merges(search.tree, wave, after, known.done, simulator.state_keys)
        nodes = search.insert(wave, outcomes, merges)
        search.tree.set_states(wave.roots, nodes, after)
        search.inserting = False
