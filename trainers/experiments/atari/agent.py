"""The hierarchical agent on Atari: a search over options before every option it carries out.

Letters: L base steps of an option, ρ simulated base steps per real one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_hmcts.arguments import name_arguments
from torchrl_hmcts.envs import AtariOptionPool
from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    HighestValue,
    MCTSPlanner,
    Search,
    SearchBudget,
    TreeRollout,
    WidthNovelty,
)
from torchrl_hmcts.trainers.experiments.atari.guide import SearchGuide


@name_arguments
@dataclass(frozen=True)
class AtariSearch:
    """How the agent searches.

    Attributes:
        ratio: simulated base steps per base step of an option, after which no new leaf is selected;
            ρ. The leaves and rollouts under way are finished: with 4 leaves and 25, about 38
            in Breakout.
        tree_policy: ``"puct"`` with a max backup over values scaled to [0, 1], or ``"uct"`` with a
            mean backup, its c times the greatest reward seen.
        c: weight of exploration.
        rollout_options: options of the rollouts that stay in the tree; 0 for none.
        leaves_per_wave: leaves that are simulated together.
        waves_in_flight: waves that are simulated at a time; 2 keep a pool's processes busy.
        width_novelty: whether states without a byte value that is new to the tree are pruned.
        reuse: whether the subtree below the option carried out is searched further.
        life_loss_penalty: what a lost life costs in planning; None for the greatest reward of an
            option seen so far.

    Raises:
        ValueError: if a number is out of range or the tree policy is unknown.

    Example:
        >>> AtariSearch(ratio=10).budget(option_steps=20)
        200
    """

    ratio: float = 25.0
    tree_policy: str = "puct"
    c: float = 2.0
    rollout_options: int = 5
    leaves_per_wave: int = 4
    waves_in_flight: int = 1
    width_novelty: bool = False
    reuse: bool = True
    life_loss_penalty: float | None = None

    def __post_init__(self) -> None:
        for name, least in (("ratio", 0.0), ("c", 0.0), ("rollout_options", 0)):
            value = getattr(self, name)
            if not least <= value < math.inf:
                raise ValueError(f"AtariSearch needs {name} >= {least:g}, finite; got {value}.")
        leaves, waves = self.leaves_per_wave, self.waves_in_flight
        if min(leaves, waves) < 1 or leaves * waves > 255:
            raise ValueError(
                f"AtariSearch needs leaves_per_wave >= 1 and waves_in_flight >= 1, with a product "
                f"of at most 255; got {leaves} and {waves}."
            )
        if self.tree_policy not in ("puct", "uct"):
            raise ValueError(
                f"AtariSearch: tree_policy is 'puct' or 'uct'; got {self.tree_policy!r}."
            )

    def budget(self, option_steps: int) -> int:
        """Simulated base steps of a decision."""
        return max(1, round(self.ratio * option_steps))

    def planner(
        self, pool: AtariOptionPool, seed: int, guide: SearchGuide | None = None
    ) -> MCTSPlanner:
        """Build the planner over a pool's options, which a network may guide."""
        rollout = TreeRollout(self.rollout_options) if self.rollout_options else None
        puct = self.tree_policy == "puct"
        return MCTSPlanner(
            pool,
            tree_policy=PUCT(c=self.c, normalize="tree") if puct else UCT(c=self.c),
            backup="max" if puct else "mean",
            expand="one",
            rollout=rollout,
            leaf_evaluator=None if guide is None else guide.evaluate,
            leaves_per_wave=self.leaves_per_wave,
            waves_in_flight=self.waves_in_flight,
            novelty=WidthNovelty("ram") if self.width_novelty else None,
            final_choice=HighestValue(random_ties=True),
            budget=SearchBudget(base_steps=self.budget(pool.max_steps), until_plan=False),
            seed=seed,
        )


@dataclass
class AtariProgress:
    """An episode so far.

    Attributes:
        score: sum of the game's rewards.
        real_steps: base steps played.
        decisions: options carried out.
        done: the episode is over.
        options: how often each option was carried out.

    Example:
        >>> AtariProgress(score=3.0, options=[0, 2]).decisions
        0
    """

    score: float = 0.0
    real_steps: int = 0
    decisions: int = 0
    done: bool = False
    options: list[int] = field(default_factory=list)


class AtariAgent:
    r"""Plays episodes: searches, carries one option out, goes on from where it led.

    The decision is the option with the highest value under a max backup,

    .. math:: o^* = \arg\max_o Q(s, o), \qquad
        Q(s, o) = R + \gamma^k \max_{o'} Q(s', o'), \qquad R = \sum_i \gamma^i (r_i - p\, l_i),

    with :math:`l_i` the lives lost and :math:`p` the penalty, in planning only: the score is the
    game's. Where nothing is known to be better, options are drawn at random.

    Two protocols. Without ``play_in`` the agent plays in the pool it plans in, a deterministic
    emulator: what was planned happens, and the subtree is kept. With ``play_in``, e.g. a pool with
    sticky actions and another seed, the planner sees the state of the game but no random generator,
    plans anew after every option, and the worker reacts to what it sees.

    Every ``replant_every`` decisions the tree is planted anew, so that an agent that is resumed
    there goes on bit for bit without its tree.

    Args:
        pool (AtariOptionPool): simulator of the options.
        search (AtariSearch): how to search.
        play_in (AtariOptionPool, optional): where to play. Default: in ``pool``.
        guide (SearchGuide, optional): learns from the searches and guides those after them.
        replant_every (int): decisions between trees planted anew. Default 100.
        seed (int): of the searches.

    Raises:
        ValueError: if the two pools have not the same options, or a number is out of range.

    Reference:
        Dissertation, chapter 5; Silver et al. 2017 for PUCT.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool, RepeatActions
        >>> from torchrl_hmcts.trainers import AtariAgent, AtariSearch
        >>> pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=5, num_processes=0,
        ...                        seed=0)
        >>> agent = AtariAgent(pool, AtariSearch(ratio=4), seed=0)
        >>> agent.begin()
        >>> agent.play(decisions=3).decisions
        3
    """

    def __init__(
        self,
        pool: AtariOptionPool,
        search: AtariSearch | None = None,
        *,
        play_in: AtariOptionPool | None = None,
        guide: SearchGuide | None = None,
        replant_every: int = 100,
        seed: int = 0,
    ) -> None:
        if replant_every < 1:
            raise ValueError(f"AtariAgent needs replant_every >= 1; got {replant_every}.")
        if play_in is not None and play_in.num_options != pool.num_options:
            raise ValueError(
                f"AtariAgent carries out what it planned; it plans over {pool.num_options} options "
                f"and plays with {play_in.num_options}. Give both pools the same worker."
            )
        self.pool, self.real = pool, pool if play_in is None else play_in
        self.settings = AtariSearch() if search is None else search
        self.guide = guide
        self.planner = self.settings.planner(pool, seed, guide)
        if guide is not None and "ram" not in self.planner.simulator.kept_keys:
            self.planner.simulator.keep(["ram"])
        self.replant_every = replant_every
        self.seed = seed
        self.greatest_reward = 0.0
        self.progress = AtariProgress(done=True)
        self.state: TensorDictBase | None = None
        self._search: Search | None = None
        self.last_step: TensorDictBase | None = None
        self.last_option = -1  # carried out by the latest decision

    @property
    def num_frames(self) -> int:
        """Frames emulated so far, real and simulated."""
        frames = self.pool.num_frames
        return frames if self.real is self.pool else frames + self.real.num_frames

    def begin(self) -> None:
        """Begin an episode."""
        self.state = self.real.reset(TensorDict(batch_size=[1]))
        self.progress = AtariProgress(options=[0] * self.pool.num_options)
        self._search = None

    def play(self, decisions: int | None = None, *, max_steps: int | None = None) -> AtariProgress:
        """Go on with the episode.

        Args:
            decisions: options to carry out at most. Default: to the end of the episode.
            max_steps: base steps of the episode at which to stop.

        Returns:
            The episode so far.
        """
        if self.state is None:
            self.begin()
        made = 0
        while not self.progress.done and (decisions is None or made < decisions):
            if max_steps is not None and self.progress.real_steps >= max_steps:
                break
            self._decide()
            made += 1
        return self.progress

    def _decide(self) -> None:
        progress, state = self.progress, self.state
        assert state is not None
        penalty = self.settings.life_loss_penalty
        self.pool.life_loss_penalty = self.greatest_reward if penalty is None else penalty
        if self.settings.tree_policy == "uct":  # exploration in units of what there is to gain
            self.planner.tree_policy = UCT(c=self.settings.c * max(self.greatest_reward, 1.0))
        seed = (self.seed * 1_000_003 + progress.decisions) & 0x7FFFFFFF
        fresh = self._search is None or progress.decisions % self.replant_every == 0
        if fresh or self.real is not self.pool or not self.settings.reuse:
            self._search = self.planner.plant(state, seed=seed)
        search = self._search
        assert search is not None
        self.planner.resume(search)
        option = torch.from_numpy(self.planner.choose(search))
        self.last_option = int(option)
        after = self.real.step(state.clone().set("option", option))["next"]
        self.last_step = after
        progress.score += float(after["score"].sum())
        progress.real_steps += int(after["duration"].sum())
        progress.decisions += 1
        progress.options[int(option)] += 1
        progress.done = bool(after["done"].any())
        self._learn_scale(search)
        if self.guide is not None:
            self.guide.learn(search, self.greatest_reward)
        self.state = after.select("emulator_state", "ram", "observation", strict=False)
        if not progress.done and self.real is self.pool and self.settings.reuse:
            self.planner.advance(search, option, self.state, seed=seed)

    def _learn_scale(self, search: Search) -> None:
        """The greatest reward that an option earned in a tree so far, which a life is worth."""
        rewards = search.tree.nodes["reward"][0, : int(search.tree.num_nodes[0])]
        self.greatest_reward = max(self.greatest_reward, float(rewards.max(initial=0.0)))

    def state_dict(self) -> dict[str, Any]:
        """Return what is needed to go on from here; the tree is planted anew."""
        progress = self.progress
        return {
            "progress": {
                "score": progress.score,
                "real_steps": progress.real_steps,
                "decisions": progress.decisions,
                "done": progress.done,
                "options": list(progress.options),
            },
            "greatest_reward": self.greatest_reward,
            "state": None if self.state is None else self.state["emulator_state"].clone(),
            "guide": None if self.guide is None else self.guide.state_dict(),
            "num_calls": self.real._num_calls,  # sticky actions are drawn by their number
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from where :meth:`state_dict` was called."""
        if self.guide is not None and state_dict.get("guide") is not None:
            self.guide.load_state_dict(state_dict["guide"])
        self.progress = AtariProgress(**state_dict["progress"])
        self.greatest_reward = float(state_dict["greatest_reward"])
        rows, self.state, self._search = state_dict["state"], None, None
        if rows is not None:
            td = TensorDict({"emulator_state": rows}, [1])
            self.state = self.real.reset(td, set_state=True)
        self.real._num_calls = int(state_dict.get("num_calls", self.real._num_calls))
