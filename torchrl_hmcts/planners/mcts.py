"""Monte Carlo tree search over the options of a macro environment.

Letters: *B batch of roots, A options, m outcomes of one wave.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.nesting import option_gamma
from torchrl_hmcts.planners.backups import Backup, MeanBackup
from torchrl_hmcts.planners.budget import SearchBudget
from torchrl_hmcts.planners.chance import ProgressiveWidening
from torchrl_hmcts.planners.choices import BestPlan, FinalChoice, MostVisited
from torchrl_hmcts.planners.growth import Growth, SearchProgress
from torchrl_hmcts.planners.node_evaluation import (
    Evaluator,
    leaf_values,
    node_codes,
    node_features,
    option_priors,
)
from torchrl_hmcts.planners.noise import DirichletNoise
from torchrl_hmcts.planners.novelty import NoveltyTest
from torchrl_hmcts.planners.plan import Plan, extract_plans
from torchrl_hmcts.planners.search import RootStates, Search, check_search, root_seeds
from torchrl_hmcts.planners.simulator import Simulator
from torchrl_hmcts.planners.transpositions import Transpositions
from torchrl_hmcts.planners.tree import TERMINAL
from torchrl_hmcts.planners.tree_policies import UCT, Gumbel, TreePolicy
from torchrl_hmcts.planners.tree_rollout import TreeRollout


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
    sampled choices) from ``s + b``, so that it has the same tree whatever is searched beside it
    (with more than one wave in flight only where it is alone: waves are of all roots together).

    Args:
        env (EnvBase): the macro environment as simulator: any env under an ``OptionTransform``, or
            any env with a discrete action, that is stateless (``batch_locked=False``, its state in
            the tensordict) or can be set to a state by ``reset(td, set_state=True)``. The planner
            steps an env of the second kind away from its state, and sets it back to the state of
            the call after a search. Transforms that remember something outside the tensordict
            are refused, except ``CatFrames``: every node has its own frames, and planning changes
            none of those of the env that is acted in.
        gamma (float, optional): discount per base step. Default: that of the env's
            ``OptionTransform``, through any nesting of envs; 0.99 for an env without durations.
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
        waves_in_flight (int): waves that are simulated at a time, the next one chosen before the
            outcomes of those before it are known. For a simulator that works beside the planner,
            such as :class:`AtariOptionPool` with processes: with 2 it has work while the planner
            inserts and selects. Outcomes are inserted in the order of the waves, whichever is
            ready first, so that the tree is the same each time (but for a budget of seconds) and
            on every simulator. Times ``leaves_per_wave`` at most 255; default 1.
        exhausted: what a descent does with an option behind which nothing is left to simulate:
            ``"skip"`` it (default: every simulation finds something new), or ``"revisit"`` it and
            back its known value up once more, at no simulator's cost, so that visits and mean
            values are those of the textbook. Always ``"revisit"`` with ``chance`` or ``Gumbel``.
        duration_key, mask_key (NestedKey): entries of the env with the base steps of a step, int64
            ``[*B, 1]`` (1 if the env has none or None is named), and the options that may be taken,
            bool ``[*B, A]`` (all if it has none or None is named). Under an ``OptionTransform``
            the mask of the base actions goes by another name, and is not that of the options.
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
        waves_in_flight: int = 1,
        exhausted: Literal["skip", "revisit"] = "skip",
        duration_key: NestedKey | None = "duration",
        mask_key: NestedKey | None = "action_mask",
        reward_key: NestedKey | None = None,
        seed: int | None = None,
        progress: Callable[[SearchProgress], None] | None = None,
    ) -> None:
        super().__init__()
        if gamma is not None and not 0.0 < gamma <= 1.0:
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
            waves_in_flight=waves_in_flight,
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
        if gamma is None:  # after the simulator's check: it must be an env
            gamma = option_gamma(env, self.simulator.duration_key)
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
        self.leaves_per_wave = int(leaves_per_wave)
        self.waves_in_flight = int(waves_in_flight)
        self.exhausted = exhausted
        self.progress = progress
        if seed is not None:
            whole_number("MCTSPlanner", "seed", seed)
        self._seeds = None if seed is None else np.random.SeedSequence(int(seed))
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
        try:
            return self._grow(search, begin, np.arange(search.num_roots))
        finally:
            self.simulator.leave(td)

    def plant(self, td: TensorDictBase, *, seed: int | None = None) -> Search:
        """Plant a tree at every state of ``td``; nothing is simulated until :meth:`resume`."""
        root = self.simulator.root(td)
        num_roots = root.batch_size[0]
        search = Search(
            num_roots, self.num_options, **self._parts(), capacity=self._capacity(num_roots)
        )
        self._seed(search, seed)
        self._plant(search, root, None)
        self.last_search = search
        return search

    def _parts(self) -> dict[str, Any]:
        """What a search is set to, as it is now, once more checked: it may have been assigned."""
        check_search(
            "MCTSPlanner",
            tree_policy=self.tree_policy,
            num_simulations=self.budget.simulations,
            expand=self.expand,
            leaves_per_wave=self.leaves_per_wave,
            exhausted=self.exhausted,
            waves_in_flight=self.waves_in_flight,
        )
        names = (
            *("tree_policy", "backup", "novelty", "transpositions", "chance", "expand"),
            *("leaves_per_wave", "waves_in_flight", "exhausted"),
        )
        return {name: getattr(self, name) for name in names}

    def _capacity(self, num_roots: int) -> int:
        """Nodes to make room for at once: all that the budget allows, if that is not very many."""
        budget = self.budget
        limits = [x for x in (budget.simulations, budget.nodes) if x is not None]
        per_wave = self.leaves_per_wave * self.waves_in_flight * self.num_options
        if not limits or num_roots * min(limits) > 2**20:
            return 64
        return min(limits) + per_wave + 1

    def resume(self, search: Search, *, where: Tensor | None = None) -> Search:
        """Continue a search, with a fresh budget; with ``Gumbel`` to the end of its schedule.

        Only the roots ``where`` (bool ``[*B]``) are searched, all by default. The search follows
        the planner: assign ``planner.tree_policy = UCT(c=5.0)`` for another constant.

        Raises:
            ValueError: if the search was planted with another backup, novelty test or the like.
        """
        search.follow(**self._parts())
        return self._grow(search, time.perf_counter(), _rows(search, where))

    def _grow(self, search: Search, begin: float, rows: np.ndarray) -> Search:
        with self.simulator.searching():
            return Growth(self, search).run(begin, rows)

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
        root = self.simulator.root(td.flatten()[index])
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
        search.seed(root_seeds("MCTSPlanner", seed, search.num_roots))

    def _plant(self, search: Search, root: TensorDictBase, rows: np.ndarray | None) -> None:
        """Plant the roots ``rows`` of a search, all by default, at the states ``root``."""
        simulator = self.simulator
        where = np.arange(search.num_roots) if rows is None else rows
        with torch.no_grad(), simulator.searching():
            done = simulator.done(root)
            masks = simulator.masks(root)
            if len(masks) and not (masks.any(-1) | done).all():
                bad = int(where[np.flatnonzero(~(masks.any(-1) | done))[0]])
                raise ValueError(
                    f"Root {bad} has no option that may be taken: its action mask is all False. "
                    f"Plan from a state that is not a dead end, or mark it as done."
                )
            looked_at = root
            if self.leaf_evaluator is not None or self.option_prior is not None:
                looked_at = root.clone()  # the state to plan from stays what it is
            values = leaf_values(
                self.leaf_evaluator,
                looked_at,
                simulator.terminated(root),
                lambda: search.seeds[where],
            )
            known = RootStates(
                values=values,
                done=done,
                priors=option_priors(self.option_prior, looked_at, self.num_options),
                masks=masks,
                features=node_features(self.novelty, root),
                codes=node_codes(self.transpositions, root),
            )
        search.start(known, rows)
        search.tree.set_states(where, np.zeros_like(where), simulator.state(root))
        if self.root_noise is not None:
            search.add_noise(self.root_noise, where)

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
