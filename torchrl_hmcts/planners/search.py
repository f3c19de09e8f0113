"""The search itself, on arrays: it asks for outcomes of options and grows the trees with them.

A wave is :meth:`Search.select`, the simulation of the triples it returns by whoever runs the
search, and :meth:`Search.insert`. Nothing here knows tensordicts or environments.
"""

from __future__ import annotations

import copy
from typing import Any, Literal, NamedTuple

import numpy as np

from torchrl_hmcts.checks import NO_LIMIT, whole_number
from torchrl_hmcts.planners.backups import Backup, MaxBackup
from torchrl_hmcts.planners.chance import ProgressiveWidening
from torchrl_hmcts.planners.noise import DirichletNoise
from torchrl_hmcts.planners.novelty import NoveltyTest
from torchrl_hmcts.planners.scored_descent import select_by_scores
from torchrl_hmcts.planners.transpositions import Transpositions
from torchrl_hmcts.planners.tree import (
    CLOSED,
    FORBIDDEN,
    LARGEST,
    PENDING,
    PRUNED,
    REWARDED,
    TERMINAL,
    WAVE,
    SearchTree,
)
from torchrl_hmcts.planners.tree_policies import PUCT, UCT, Gumbel, TreePolicy

_MOST_HALVED = 2**24  # simulations of Gumbel, whose schedule holds counts in float32


class Wave:
    """What to simulate next: take ``options[i]`` in node ``nodes[i]`` of root ``roots[i]``."""

    def __init__(self, records: np.ndarray, *, detached: bool = False) -> None:
        self.records = records  # [m] of tree.WAVE
        self.detached = detached  # others may be selected before it is inserted
        self.roots = records["root"].copy()  # [m] int64
        self.nodes = records["node"].copy()  # [m] int64
        self.options = records["option"].copy()  # [m] int64

    def __len__(self) -> int:
        return len(self.records)


class Outcomes(NamedTuple):
    """What came of a wave's triples."""

    rewards: np.ndarray  # [m] float32, R
    discounts: np.ndarray  # [m] float32, D: gamma ** duration, 0 after a terminal state
    durations: np.ndarray  # [m] int64, base steps
    done: np.ndarray  # [m] bool: terminated or truncated
    values: np.ndarray  # [m] float32, the leaf evaluator's
    priors: np.ndarray  # [m, A] float32, or [0, A] for uniform
    masks: np.ndarray  # [m, A] bool: options that may be taken, or [0, A] for all
    features: np.ndarray | None = None  # [m, F], the novelty test's
    codes: np.ndarray | None = None  # [m, K] uint8, states as bytes: for equal states


class RootStates(NamedTuple):
    """What is known of roots before they are searched."""

    values: np.ndarray  # [m] float32
    done: np.ndarray  # [m] bool
    priors: np.ndarray  # [m, A] float32, or [0, A] for uniform
    masks: np.ndarray  # [m, A] bool, or [0, A] for all
    features: np.ndarray | None = None  # [m, F]
    codes: np.ndarray | None = None  # [m, K] uint8


def _check_rows(known: Outcomes | RootStates, m: int, num_options: int) -> None:
    """Refuse arrays without a row for each of ``m`` states: the kernels trust them."""
    for name, array in zip(known._fields, known, strict=True):
        if array is None:
            continue
        shape = array.shape
        wide = name in ("priors", "masks")
        if shape[0] == m and (not wide or shape[1] == num_options):
            continue
        if not wide or shape != (0, num_options):
            expected = [m, num_options] if wide else [m]
            raise ValueError(
                f"A search got {name} {list(shape)} for {m} states; it needs {expected}."
            )


def check_search(
    owner: str,
    *,
    tree_policy: TreePolicy,
    num_simulations: int | None,
    expand: str,
    leaves_per_wave: int,
    exhausted: str,
    waves_in_flight: int = 1,
) -> None:
    """Refuse arguments that make no search, with a message in the name of ``owner``.

    Raises:
        ValueError: if an argument is out of range, or does not go with ``Gumbel``.
        TypeError: if ``tree_policy`` is none.
    """
    for name, value, names in (
        ("expand", expand, ("all", "one")),
        ("exhausted", exhausted, ("skip", "revisit")),
    ):
        if value not in names:
            raise ValueError(f"{owner}: {name} is {names[0]!r} or {names[1]!r}; got {value!r}.")
    leaves_per_wave = whole_number(owner, "leaves_per_wave", leaves_per_wave)
    waves_in_flight = whole_number(owner, "waves_in_flight", waves_in_flight)
    if not 1 <= leaves_per_wave <= 255:
        raise ValueError(f"{owner} needs leaves_per_wave from 1 to 255; got {leaves_per_wave}.")
    if waves_in_flight < 1 or leaves_per_wave * waves_in_flight > 255:
        raise ValueError(
            f"{owner} needs waves_in_flight >= 1, with leaves_per_wave * waves_in_flight <= 255; "
            f"got waves_in_flight={waves_in_flight}, leaves_per_wave={leaves_per_wave}."
        )
    if not callable(tree_policy) and not isinstance(tree_policy, (UCT, PUCT, Gumbel)):
        raise TypeError(
            f"{owner} needs a tree policy: UCT(), PUCT(), Gumbel(), TorchRLScore(...) or a "
            f"callable over NodeStatistics; got {tree_policy!r}."
        )
    if isinstance(tree_policy, Gumbel) and (
        num_simulations is None or expand != "one" or leaves_per_wave * waves_in_flight != 1
    ):
        raise ValueError(
            f"Gumbel halves a known number of simulations of one option each; got "
            f"budget.simulations={num_simulations}, expand={expand!r}, "
            f"leaves_per_wave={leaves_per_wave}, waves_in_flight={waves_in_flight}. Pass "
            f"budget=SearchBudget(simulations=32, until_plan=False), expand='one' and "
            f"leaves_per_wave=1."
        )
    if isinstance(tree_policy, Gumbel) and (num_simulations or 0) > _MOST_HALVED:
        raise ValueError(
            f"{owner}: Gumbel plans every simulation ahead, {_MOST_HALVED:,} at most; got "
            f"{num_simulations:,}."
        )


def _is_same(one: Any, other: Any) -> bool:
    """Whether two parts of a planner do the same; a copy of a search holds copies of them."""
    if one is other or type(one) is not type(other):
        return one is other
    if type(one).__repr__ is object.__repr__:
        return True
    return one == other or repr(one) == repr(other)


def _goes_on(one: TreePolicy, other: TreePolicy) -> bool:
    """Whether a search by one tree policy has kept all that the other needs."""
    if isinstance(one, PUCT) and isinstance(other, PUCT):
        return one.normalize == other.normalize
    if isinstance(one, UCT) or isinstance(other, UCT):
        return type(one) is type(other)
    compiled = isinstance(one, (PUCT, Gumbel)), isinstance(other, (PUCT, Gumbel))
    return not any(compiled) or one == other


def root_seeds(owner: str, seed: int, num_roots: int) -> np.ndarray:
    """Return ``seed + b`` for root b, int64 ``[B]``, modulo 2 ** 63."""
    whole_number(owner, "seed", seed)
    first = np.uint64(int(seed) & NO_LIMIT)
    return ((np.arange(num_roots, dtype=np.uint64) + first) & np.uint64(NO_LIMIT)).astype(np.int64)


class Search:
    """The trees of ``B`` roots under one tree policy, backup and novelty test.

    Args:
        num_roots: B.
        num_options: A.
        tree_policy: see :mod:`~torchrl_hmcts.planners.tree_policies`.
        backup: see :mod:`~torchrl_hmcts.planners.backups`.
        novelty: see :mod:`~torchrl_hmcts.planners.novelty`, or None.
        transpositions: see :mod:`~torchrl_hmcts.planners.transpositions`, or None.
        chance: see :mod:`~torchrl_hmcts.planners.chance`, or None for a deterministic simulator.
        expand: ``"all"`` simulates every option of a leaf, ``"one"`` the option the tree policy
            chooses.
        leaves_per_wave: leaves each root contributes to a wave, at most 255.
        exhausted: what a descent does with an option behind which nothing is left to simulate:
            ``"skip"`` it, or ``"revisit"`` it and back its known value up once more.
        waves_in_flight: waves that are selected before the first of them is inserted.
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
        *,
        tree_policy: TreePolicy,
        backup: Backup,
        novelty: NoveltyTest | None = None,
        transpositions: Transpositions | None = None,
        chance: ProgressiveWidening | None = None,
        expand: Literal["all", "one"] = "all",
        leaves_per_wave: int = 1,
        exhausted: Literal["skip", "revisit"] = "skip",
        waves_in_flight: int = 1,
        capacity: int = 64,
    ) -> None:
        from torchrl_hmcts.planners import kernels

        self._kernels = kernels
        self._parts = {
            "backup": backup,
            "novelty": novelty,
            "transpositions": transpositions,
            "chance": chance,
            "expand": expand,
            "exhausted": exhausted,
        }
        self.tree_policy = tree_policy
        # Copies: what one search has seen is nothing to the next, nor to one that is resumed later.
        self.novelty = copy.copy(novelty)
        self.transpositions = copy.copy(transpositions)
        self.num_options = whole_number("Search", "num_options", num_options, least=1)
        self.num_roots = whole_number("Search", "num_roots", num_roots)
        capacity = whole_number("Search", "capacity", capacity, least=1)
        self.expand_all = expand == "all"
        self.growing = False  # also after an interruption: some of it may have been in flight
        self.inserting = False  # also after an interruption: nodes may be there without a state
        self.stochastic = chance is not None
        self.max_backup = isinstance(backup, MaxBackup)
        self.settings = np.zeros(1, kernels.SETTINGS)
        settings = self.settings[0]
        settings["backup"] = kernels.MAX_BACKUP if self.max_backup else kernels.MEAN_BACKUP
        settings["expand_all"] = self.expand_all
        # Chance options never close, and halving counts visits: both land on what they know.
        revisit = exhausted == "revisit" or self.stochastic or isinstance(tree_policy, Gumbel)
        settings["revisit"] = revisit
        settings["twins"] = transpositions is not None
        if chance is not None:
            settings["widening"], settings["widening_exponent"] = chance.k, chance.alpha
        self._set_policy(tree_policy)
        self._set_waves(leaves_per_wave, waves_in_flight)
        self.tree = SearchTree(num_roots, num_options, capacity=capacity)
        self._gumbel = np.zeros((0, 0), np.float32)
        self.seed(np.arange(num_roots))
        self._room = 1  # nodes of the largest tree, at most

    def __getstate__(self) -> dict[str, Any]:  # a module can be neither copied nor sent
        return {**self.__dict__, "_kernels": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        from torchrl_hmcts.planners import kernels

        self.__dict__.update(state, _kernels=kernels)

    def _set_waves(self, leaves_per_wave: int, waves_in_flight: int) -> None:
        self.leaves_per_wave, self.waves_in_flight = leaves_per_wave, waves_in_flight
        self.settings["leaves"] = leaves_per_wave
        # Options on the way down are marked for other descents, and always for those in Python.
        alone = leaves_per_wave * waves_in_flight == 1 and self._scores is None
        self.settings["mark"] = not alone
        per_leaf = self.num_options if self.expand_all else 1
        self._wave = np.zeros(self.num_roots * leaves_per_wave * per_leaf, WAVE)

    def follow(
        self,
        *,
        tree_policy: TreePolicy,
        leaves_per_wave: int,
        waves_in_flight: int,
        **parts: Any,
    ) -> None:
        """Take over what the planner is set to now: constants of the tree policy, and waves.

        Args:
            tree_policy: of the kind that the search was planted with.
            leaves_per_wave: leaves of each root in a wave.
            waves_in_flight: waves under way at a time.
            parts: the other keywords of the constructor, which must be what they were.

        Raises:
            ValueError: if anything else differs, since what the tree holds would not fit it.
        """
        kept: dict[str, Any] = {"tree_policy": self.tree_policy, **self._parts}
        now = {"tree_policy": tree_policy, **parts}
        for name in parts:
            if not _is_same(kept[name], now[name]):
                break
        else:
            name = "tree_policy"
            if tree_policy is kept[name] or _goes_on(kept[name], tree_policy):
                self._set_policy(tree_policy)
                self._set_waves(leaves_per_wave, waves_in_flight)
                return
        raise ValueError(
            f"This search was planted with {name}={kept[name]!r}; the planner now has "
            f"{name}={now[name]!r}. What the tree holds does not fit it: plant a new one, or "
            f"resume it with a planner like the first."
        )

    def _set_policy(self, tree_policy: TreePolicy) -> None:
        kernels, settings = self._kernels, self.settings[0]
        self.tree_policy = tree_policy
        self._scores = None
        if isinstance(tree_policy, UCT):
            settings["score"], settings["c"] = kernels.UCT_SCORE, tree_policy.c
        elif isinstance(tree_policy, PUCT):
            settings["score"], settings["c"] = kernels.PUCT_SCORE, tree_policy.c
            settings["c_base"] = tree_policy.c_base or 0.0
            settings["unvisited_value"] = tree_policy.unvisited_value
            settings["normalize"] = {
                None: kernels.RAW_VALUES,
                "siblings": kernels.SIBLINGS,
                "tree": kernels.WHOLE_TREE,
            }[tree_policy.normalize]
        elif isinstance(tree_policy, Gumbel):
            settings["score"], settings["c"] = kernels.GUMBEL_SCORE, tree_policy.c_visit
            settings["c_scale"] = tree_policy.c_scale
        else:
            self._scores = tree_policy
        if isinstance(tree_policy, UCT | PUCT):
            kernels.fill_factors(self.settings)

    # ------------------------------------------------------------------ what is known of the roots

    @property
    def roots(self) -> np.ndarray:
        """Counters of the roots, ``[B]`` of ``tree.ROOT``."""
        return self.tree.roots

    @property
    def num_simulations(self) -> np.ndarray:
        """Options simulated or revisited since :meth:`begin`, int64 ``[B]``."""
        return self.roots["simulations"]

    @property
    def num_expansions(self) -> np.ndarray:
        """Expansions since :meth:`begin`, int64 ``[B]``."""
        return self.roots["expansions"]

    @property
    def num_base_steps(self) -> np.ndarray:
        """Base steps simulated since :meth:`begin`, int64 ``[B]``."""
        return self.roots["base_steps"]

    @property
    def best_node(self) -> np.ndarray:
        """End of the best plan so far, int64 ``[B]``, -1 without one."""
        return self.roots["best_node"]

    @property
    def best_return(self) -> np.ndarray:
        """Discounted return of the best plan so far, float64 ``[B]``, -inf without one."""
        return self.roots["best_return"]

    @property
    def expansions_to_plan(self) -> np.ndarray:
        """Expansions when the first plan was found, int64 ``[B]``, -1 without one."""
        return self.roots["expansions_to_plan"]

    @property
    def base_steps_to_plan(self) -> np.ndarray:
        """Base steps simulated when the first plan was found, int64 ``[B]``, -1 without one."""
        return self.roots["base_steps_to_plan"]

    # ------------------------------------------------------------------ growing

    def begin(self, max_simulations: int | None = None) -> None:
        """Count simulations, expansions and base steps from 0, up to a number of simulations.

        What an interruption left in flight is forgotten.

        Raises:
            RuntimeError: if the interruption came while outcomes were inserted.
        """
        if self.inserting:
            raise RuntimeError(
                "This search was interrupted while outcomes were inserted: it may have nodes "
                "without a state, and cannot go on. Its plans and values can be read; search anew "
                "to go on."
            )
        if self.growing:
            self.tree.edges["in_flight"] = 0
            self.tree.nodes["flags"] &= ~PENDING
            self.roots["scheduled"] = 0
            self.growing = False
        limit = NO_LIMIT if max_simulations is None else max_simulations
        self._kernels.begin(self.tree.roots, limit)

    def start(self, known: RootStates, rows: np.ndarray | None = None) -> None:
        """Plant the roots ``rows`` (all by default), one for each row of ``known``."""
        first = rows is None
        if rows is None:
            rows = np.arange(self.num_roots)
        _check_rows(known, len(rows), self.num_options)
        if len(rows) and not (0 <= rows.min() and rows.max() < self.num_roots):
            raise ValueError(f"A search of {self.num_roots} roots has no roots {rows}.")
        tree = self.tree
        for test, codes in ((self.novelty, known.features), (self.transpositions, known.codes)):
            if test is not None:
                assert codes is not None
                if first:
                    test.start(self.num_roots)
                else:
                    for root in rows:
                        test.restart(int(root))
        if known.features is not None and first:
            features = known.features
            shape = (self.num_roots, tree.capacity, features.shape[1])
            tree.features = np.zeros(shape, features.dtype)
        if known.codes is not None and first:
            shape = (self.num_roots, tree.capacity, known.codes.shape[1])
            tree.codes = np.zeros(shape, np.uint8)
        self._kernels.add_roots(
            tree.nodes, tree.edges, tree.roots, rows, known.values, known.done, known.priors,
            known.masks,
        )  # fmt: skip
        zeros = np.zeros(len(rows), np.int64)
        self._remember(rows, zeros, known.features, known.codes)
        if self.novelty is not None and known.features is not None:
            self.novelty.accept(rows.copy(), known.features.copy(), zeros.copy())
        if self.transpositions is not None and known.codes is not None:
            self.transpositions.find(rows, known.codes, zeros)

    def _remember(
        self,
        roots: np.ndarray,
        nodes: np.ndarray,
        features: np.ndarray | None,
        codes: np.ndarray | None,
    ) -> None:
        if features is not None:
            self.tree.features[roots, nodes] = features
        if codes is not None:
            self.tree.codes[roots, nodes] = codes

    def select(self, active: np.ndarray | None = None) -> Wave:
        """Choose the options to simulate for the roots ``active`` (all that are, by default).

        A root that is exhausted or has spent its simulations adds none.
        """
        if active is not None:
            self.roots["active"] = 0
            self.roots["active"][active] = 1
        tree = self.tree
        if self._scores is not None:
            try:
                count = select_by_scores(self, self._scores, self._wave)
            except BaseException:  # e.g. a policy that raises: forget the half-made wave
                tree.edges["in_flight"] = 0
                tree.nodes["flags"] &= ~PENDING
                raise
        else:
            count = self._kernels.select(
                tree.nodes, tree.edges, tree.roots, self.settings, self._gumbel, self._wave
            )
        return Wave(self._wave[:count])

    def extend(self, wave: Wave) -> Wave:
        """Choose an option, by its prior, of every node that a wave has added and that goes on.

        Only with ``expand="one"``. Each root draws its own random numbers.
        """
        draws = np.empty(len(wave))
        for root in sorted(set(wave.roots.tolist())):
            if root not in self._rollouts:
                self._rollouts[root] = self.generator(root, "rollout")
            rows = wave.roots == root
            draws[rows] = self._rollouts[root].random(int(rows.sum()))
        tree, ended = self.tree, wave.records.copy()
        count = self._kernels.extend(
            tree.nodes, tree.edges, tree.roots, self.settings, ended, draws, self._wave
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
        self._kernels.cancel(self.tree.nodes, self.tree.edges, self.settings, wave.records)

    def insert(
        self, wave: Wave, outcomes: Outcomes, merges: np.ndarray | None = None
    ) -> np.ndarray:
        """Append the outcomes of a wave and back them up; return their nodes, int64 ``[m]``.

        ``merges`` (int64 ``[m]``) names the outcome of the same option that has the same state, or
        -1; only in a stochastic simulator.
        """
        tree, m = self.tree, len(wave)
        _check_rows(outcomes, m, self.num_options)
        bad = self._kernels.first_bad(
            outcomes.rewards, outcomes.discounts, outcomes.values, outcomes.priors
        )
        if bad >= 0:
            raise ValueError(
                f"An outcome has the reward {outcomes.rewards[bad]}, the discount "
                f"{outcomes.discounts[bad]}, the value {outcomes.values[bad]} and the priors "
                f"{outcomes.priors[bad : bad + 1].tolist()}. All must be finite, rewards and "
                f"values smaller than {LARGEST:g}, discounts in [0, 1] and priors not negative; "
                f"scale the rewards, or find the step from which the env wrote them."
            )
        if merges is not None and not (
            len(merges) == m and (merges < tree.num_nodes[wave.records["root"]]).all()
        ):
            raise ValueError(f"merges must name {m} nodes of the tree, or -1; got {merges}.")
        self._attach(wave)
        self.inserting = tree.states is not None  # until the new states are stored, too
        self._reserve_wave()
        novel = np.ones(m, np.bool_)
        nothing = np.empty(0, np.int64)
        twins = nothing
        if self.transpositions is not None or self.novelty is not None:
            goes_on = np.flatnonzero(~outcomes.done)
            roots = wave.roots[goes_on]
        if self.transpositions is not None:
            assert outcomes.codes is not None
            twins = np.full(m, -1, np.int64)
            nodes = self._kernels.number_nodes(tree.roots, wave.roots)
            twins[goes_on] = self.transpositions.find(
                roots, outcomes.codes[goes_on], nodes[goes_on]
            )
            goes_on = goes_on[twins[goes_on] < 0]
            roots = wave.roots[goes_on]
        if self.novelty is not None:
            assert outcomes.features is not None
            steps = tree.nodes["base_steps"][wave.roots, wave.nodes] + outcomes.durations
            novel[goes_on] = self._accept(roots, outcomes.features[goes_on], steps[goes_on])
        self._kernels.insert(
            tree.nodes, tree.edges, tree.roots, self.settings, wave.records, outcomes.rewards,
            outcomes.discounts, outcomes.durations, outcomes.done, novel, twins,
            nothing if merges is None else merges, outcomes.values, outcomes.priors,
            outcomes.masks,
        )  # fmt: skip
        new_nodes = np.ascontiguousarray(wave.records["new_node"])
        self._remember(wave.roots, new_nodes, outcomes.features, outcomes.codes)
        return new_nodes

    def _accept(self, roots: np.ndarray, features: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """The answer of the novelty test, bool ``[m]``."""
        assert self.novelty is not None
        novel = np.asarray(self.novelty.accept(roots, features, steps))
        if novel.shape != (len(features),) or novel.dtype != np.bool_:
            raise ValueError(
                f"The novelty test accepted {novel.dtype} {list(novel.shape)}; it must say of each "
                f"of the {len(features)} states whether it is new, in bool."
            )
        return novel

    def seed(self, seeds: np.ndarray) -> None:
        """Give each root the seed of its random numbers, int64 ``[B]``."""
        self.seeds = seeds
        self._rollouts: dict[int, np.random.Generator] = {}

    def generator(self, root: int, purpose: str) -> np.random.Generator:
        """Return random numbers that depend on the root's seed and on what they are for."""
        return np.random.default_rng([int(self.seeds[root]), *purpose.encode()])

    def add_noise(self, noise: DirichletNoise, roots: np.ndarray) -> None:
        """Mix noise into the priors of the roots' options."""
        edges = self.tree.edges
        for b in roots.tolist():
            allowed = edges["closed"][b, 0] != FORBIDDEN
            prior = np.where(allowed, edges["prior"][b, 0], 0.0)
            drawn = np.zeros(self.num_options)
            if not allowed.any() or noise.fraction == 0.0:
                continue
            drawn[allowed] = self.generator(b, "noise").dirichlet(
                np.full(int(allowed.sum()), noise.alpha)
            )
            prior = prior / max(prior.sum(), 1e-12)
            edges["prior"][b, 0] = (1.0 - noise.fraction) * prior + noise.fraction * drawn

    def halve(self, num_simulations: int) -> None:
        """Draw the Gumbel noise of the roots, and plan how simulations are halved among options."""
        policy = self.tree_policy
        assert isinstance(policy, Gumbel)
        allowed = self.allowed()
        self._gumbel = np.zeros((self.num_roots, self.num_options + num_simulations), np.float32)
        schedules: dict[int, list[int]] = {}
        with np.errstate(divide="ignore"):
            logits = np.log(self.tree.edges["prior"][:, 0])
        self._gumbel[:, : self.num_options] = np.maximum(logits, -1e9)
        for b, num_allowed in enumerate(allowed.sum(-1).tolist()):
            if policy.scale > 0.0:
                noise = self.generator(b, "gumbel").gumbel(size=self.num_options)
                self._gumbel[b, : self.num_options] += policy.scale * noise
            considered = min(policy.max_considered, num_allowed)
            if considered not in schedules:
                schedules[considered] = policy.considered_visits(considered, num_simulations)
            self._gumbel[b, self.num_options :] = schedules[considered]

    def gumbel_choice(self) -> np.ndarray:
        """Return the option that a Gumbel search ends on for each root, int64 ``[B]``."""
        assert isinstance(self.tree_policy, Gumbel)
        tree, sigma = self.tree, np.empty(self.num_options)
        allowed = self.allowed()
        visits = np.where(allowed, tree.edges["visits"][:, 0], -1)
        scores = np.where(visits == visits.max(-1, keepdims=True), 0.0, -np.inf)
        for b in range(self.num_roots):
            self._kernels.completed_values(tree.nodes, tree.edges, self.settings, b, 0, sigma)
            scores[b] += self._gumbel[b, : self.num_options] + sigma
        choice: np.ndarray = np.where(allowed, scores, -np.inf).argmax(-1)
        return choice

    def _reserve_wave(self) -> None:
        """Make room for the nodes of one wave."""
        per_root = len(self._wave) // max(self.num_roots, 1)
        if self._room + per_root > self.tree.capacity:
            self._room = int(self.tree.num_nodes.max(initial=1))
            self.tree.reserve(self._room + per_root)
        self._room += per_root

    def exhausted(self, roots: np.ndarray) -> np.ndarray:
        """Return which of the roots have nothing left to simulate, bool ``[len(roots)]``."""
        return (self.tree.nodes["flags"][roots, 0] & CLOSED) != 0

    @property
    def revisits_exhausted(self) -> bool:
        """Whether an exhausted root still spends its simulations on what it knows."""
        revisit = bool(self.settings["revisit"][0])
        return revisit and bool((self.roots["limit"] != NO_LIMIT).all())

    def relax(self, root: int) -> bool:
        """Make the novelty test less strict for an exhausted root; return whether it opened."""
        if self.novelty is None:
            return False
        tree = self.tree
        while self.novelty.relax(root):
            flags = tree.nodes["flags"][root, : tree.num_nodes[root]]
            pruned = np.flatnonzero(flags & PRUNED)
            pruned = pruned[tree.nodes["twin"][root, pruned] < 0]
            if not len(pruned):
                return False
            self._reopen(root, pruned)
            if not self.exhausted(np.array([root]))[0]:
                return True
        return False

    def _reopen(self, root: int, pruned: np.ndarray) -> None:
        """Put nodes that were refused to the novelty test again."""
        tree = self.tree
        again = np.ones(len(pruned), np.bool_)
        if self.novelty is not None:
            again = self._accept(
                np.full(len(pruned), root),
                np.ascontiguousarray(tree.features[root, pruned]),
                tree.nodes["base_steps"][root, pruned].astype(np.int64),
            )
        for node in pruned[again]:
            self._kernels.reopen(tree.nodes, tree.edges, root, node)

    def solve(self, root: int, tolerance: float = 1e-7) -> None:
        """Make the values of an exhausted tree exact, where equal states share what is known.

        With a max backup only; without transpositions they are exact already.
        """
        if self.max_backup and self.transpositions is not None:
            tree = self.tree
            self._kernels.solve(tree.nodes, tree.edges, tree.roots, root, tolerance, 10_000)

    # ------------------------------------------------------------------ from decision to decision

    def outcomes_of(self, root: int, option: int, node: int = 0) -> list[int]:
        """Return the nodes that an option of a node, the root by default, has led to."""
        nodes, child = [], int(self.tree.edges["child"][root, node, option])
        while child >= 0:
            nodes.append(child)
            child = int(self.tree.nodes["sibling"][root, child])
        return nodes

    def reroot(self, root: int, node: int) -> None:
        """Make a node the new root: its subtree stays, with all values, the rest is dropped."""
        tree = self.tree
        if not (0 <= root < self.num_roots and 0 <= node < tree.num_nodes[root]):
            raise ValueError(f"Root {root} of {self.num_roots} has no node {node} to move to.")
        kept = np.empty(tree.num_nodes[root], np.int64)
        count = self._kernels.reroot(tree.nodes, tree.edges, tree.roots, root, node, kept)
        kept = kept[:count]
        tree.features[root, :count] = tree.features[root, kept]
        tree.codes[root, :count] = tree.codes[root, kept]
        if tree.states is not None:
            rows = tree.states[root]
            rows[:count] = rows[kept]
        flags = tree.nodes["flags"][root, :count]
        goes_on = np.flatnonzero((flags & (PRUNED | TERMINAL)) == 0)
        pruned = np.flatnonzero((flags & PRUNED) != 0)
        if self.transpositions is not None:
            self.transpositions.restart(root)
            self.transpositions.find(
                np.full(len(goes_on), root),
                np.ascontiguousarray(tree.codes[root, goes_on]),
                goes_on,
            )
            twins = self.transpositions.find(
                np.full(len(pruned), root), np.ascontiguousarray(tree.codes[root, pruned]), pruned
            )
            tree.nodes["twin"][root, pruned] = twins
            pruned = pruned[twins < 0]
        if self.novelty is not None:
            self.novelty.restart(root)
            self.novelty.accept(
                np.full(len(goes_on), root),
                np.ascontiguousarray(tree.features[root, goes_on]),
                tree.nodes["base_steps"][root, goes_on].astype(np.int64),
            )
        if len(pruned):  # what refused them may be gone
            self._reopen(root, pruned)
        self._room = tree.capacity

    # ------------------------------------------------------------------ looking at it

    def allowed(self, nodes: np.ndarray | int = 0) -> np.ndarray:
        """Return the options that may be taken in a node of each root, bool ``[B, A]``."""
        rows = np.arange(self.num_roots)
        allowed: np.ndarray = self.tree.edges["closed"][rows, nodes] != FORBIDDEN
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
