"""The hierarchical agent on Atari: a search over options before every option it executes.

Letters: L base steps of an option, ρ simulated base steps per real one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.envs import AtariOptionPool
from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    HighestValue,
    MCTSPlanner,
    Search,
    SearchBudget,
    SearchSettings,
    TreeRollout,
    WidthNovelty,
)
from torchrl_hmcts.trainers.experiments.atari.guide import SearchGuide
from torchrl_hmcts.trainers.experiments.atari.reactive import ReactiveManager


@dataclass(frozen=True)
class AtariSearch:
    """Settings of the agent's search.

    Attributes:
        ratio: simulated base steps per base step of an option, after which no new leaf is selected;
            ρ. 0: the guide chooses, without search. The leaves and rollouts under way are finished:
            with 4 leaves and 25, about 38 in Breakout.
        tree_policy: ``"puct"`` over values scaled to [0, 1], or ``"uct"``, its c times the greatest
            reward seen.
        backup: ``"max"``, ``"mean"`` or ``"default"``: the max for PUCT, the mean for UCT.
        c: weight of exploration.
        rollout_options: options of the rollouts that stay in the tree; 0 for none.
        leaves_per_wave: leaves that are simulated together.
        waves_in_flight: waves that are simulated at a time; 2 keep a pool's processes busy.
        width_novelty: whether states without a byte value that is new to the tree are pruned.

    Raises:
        TypeError: if a number is none.
        ValueError: if a number is out of range or the tree policy is unknown.

    Example:
        >>> from torchrl_hmcts.trainers import AtariSearch
        >>> AtariSearch(ratio=10).budget(option_steps=20)
        200
    """

    ratio: float = 25.0
    tree_policy: str = "puct"
    backup: str = "default"
    c: float = 2.0
    rollout_options: int = 5
    leaves_per_wave: int = 4
    waves_in_flight: int = 1
    width_novelty: bool = False

    def __post_init__(self) -> None:
        real_number("AtariSearch", "ratio", self.ratio, least=0.0)
        whole_number("AtariSearch", "rollout_options", self.rollout_options)
        if not isinstance(self.tree_policy, str) or self.tree_policy not in ("puct", "uct"):
            raise ValueError(
                f"AtariSearch: tree_policy is 'puct' or 'uct'; got {self.tree_policy!r}."
            )
        if self.backup not in ("default", "max", "mean"):
            raise ValueError(
                f"AtariSearch: backup is 'default', 'max' or 'mean'; got {self.backup!r}."
            )
        self.settings()  # which checks the rest

    def budget(self, option_steps: int) -> int:
        """Return the simulated base steps of a decision."""
        return max(1, round(self.ratio * option_steps))

    def settings(self, reward_scale: float = 1.0) -> SearchSettings:
        """Return the settings of a search.

        Args:
            reward_scale: what there is to gain, in units of which UCT explores.
        """
        puct = self.tree_policy == "puct"
        backup: Any = ("max" if puct else "mean") if self.backup == "default" else self.backup
        return SearchSettings(
            tree_policy=PUCT(c=self.c, normalize="tree") if puct else UCT(c=self.c * reward_scale),
            backup=backup,
            expand="one",
            rollout=TreeRollout(self.rollout_options) if self.rollout_options else None,
            leaves_per_wave=self.leaves_per_wave,
            waves_in_flight=self.waves_in_flight,
            novelty=WidthNovelty("ram") if self.width_novelty else None,
        )


class AtariAgent:
    r"""Plays episodes: searches, executes one option, continues from where it led.

    The decision is the option with the highest value under a max backup,

    .. math:: o^* = \arg\max_o Q(s, o), \qquad
        Q(s, o) = R + \gamma^k \max_{o'} Q(s', o'), \qquad R = \sum_i \gamma^i (r_i - p\, l_i),

    with :math:`l_i` the lives lost and :math:`p` the greatest reward of an option so far, in
    planning only: the score is the game's. Where nothing is known to be better, options are drawn
    at random.

    Two protocols. Without ``play_in`` the agent plays in the pool it plans in, a deterministic
    emulator: what was planned happens, and the subtree is kept. With ``play_in``, e.g. a pool with
    sticky actions and another seed, the planner sees the state of the game but no random generator,
    plans again after every option, and the worker reacts to what it sees.

    Every ``replant_every`` decisions a new tree begins, so that an agent that is resumed there
    continues bit for bit without its tree. So it does under UCT when a greater reward was seen.

    Args:
        pool (AtariOptionPool): simulator of the options.
        search (AtariSearch): how to search.
        play_in (AtariOptionPool, optional): where to play. Default: in ``pool``.
        guide (SearchGuide or ReactiveManager, optional): learns from the searches and guides
            those after them; needed with a ratio of 0.
        replant_every (int): decisions between new trees. Default 100.
        seed (int): of the searches.

    Attributes:
        score: sum of the game's rewards in the episode so far.
        real_steps: base steps played.
        decisions: options executed.
        done: whether the episode is over; true before the first begins.
        options_taken: how often each option was executed.

    Raises:
        ValueError: if the two pools have not the same options, a number is out of range, or nothing
            chooses: a ratio of 0 without a ReactiveManager.

    Reference:
        Dissertation, chapter 5; Silver et al. 2017 for PUCT.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool, RepeatActions
        >>> from torchrl_hmcts.trainers import AtariAgent, AtariSearch
        >>> pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=5, num_processes=0,
        ...                        seed=0)
        >>> agent = AtariAgent(pool, AtariSearch(ratio=4), seed=0)
        >>> agent.play(decisions=3).decisions
        3
    """

    def __init__(
        self,
        pool: AtariOptionPool,
        search: AtariSearch | None = None,
        *,
        play_in: AtariOptionPool | None = None,
        guide: SearchGuide | ReactiveManager | None = None,
        replant_every: int = 100,
        seed: int = 0,
    ) -> None:
        if play_in is not None and play_in.num_options != pool.num_options:
            raise ValueError(
                f"AtariAgent executes what it planned; it plans over {pool.num_options} options "
                f"and plays with {play_in.num_options}. Give both pools the same worker."
            )
        self.replant_every = whole_number("AtariAgent", "replant_every", replant_every, least=1)
        self.pool, self.real = pool, pool if play_in is None else play_in
        self.search = AtariSearch() if search is None else search
        if self.search.ratio == 0.0 and not isinstance(guide, ReactiveManager):
            raise ValueError(
                f"AtariAgent with a ratio of 0 does not search: a ReactiveManager chooses; got "
                f"guide={guide!r}. Pass one, or a ratio above 0."
            )
        self.guide = guide
        self.seed = seed
        self.greatest_reward = 0.0
        self.guided = guide is not None
        self.state: TensorDictBase | None = None
        self.last_option = -1  # executed by the latest decision
        self._tree: Search | None = None
        self._new_episode(done=True)
        self._make_planner()

    def _new_episode(self, done: bool = False) -> None:
        self.score, self.real_steps, self.decisions, self.done = 0.0, 0, 0, done
        self.options_taken = [0] * self.pool.num_options

    def _make_planner(self) -> None:
        """Make the planner; under UCT exploration is worth what there is to gain."""
        self._scale, search = self._wanted_scale, self.search
        if self.guided and isinstance(self.guide, ReactiveManager):
            search = replace(search, rollout_options=0)  # its values take their place
        self.planner = MCTSPlanner(
            self.pool,
            **vars(search.settings(self._scale)),
            leaf_evaluator=self.guide if self.guided else None,
            final_choice=HighestValue(random_ties=True),
            budget=SearchBudget(
                base_steps=self.search.budget(self.pool.max_steps), until_plan=False
            ),
            seed=self.seed,
        )
        if self.guide is not None:
            self.planner.simulator.keep(self.guide.in_keys)  # in the tree, from which it learns
        self._tree = None

    @property
    def _wanted_scale(self) -> float:
        return max(self.greatest_reward, 1.0) if self.search.tree_policy == "uct" else 1.0

    @property
    def num_frames(self) -> int:
        """Frames emulated so far, real and simulated."""
        frames = self.pool.num_frames
        return frames if self.real is self.pool else frames + self.real.num_frames

    def close(self) -> None:
        """Stop the processes of the pools."""
        self.pool.close()
        if self.real is not self.pool:
            self.real.close()

    def begin(self, guided: bool = True) -> None:
        """Begin an episode.

        Args:
            guided: whether the guide has a say; it learns from the searches in either case.
        """
        if self.guide is not None and guided != self.guided:
            self.guided = guided
            self._make_planner()
        self.state = self.real.reset(TensorDict(batch_size=[1]))
        self._tree = None
        self._new_episode()

    def play(self, decisions: int | None = None, *, max_steps: int | None = None) -> AtariAgent:
        """Continue the episode, or begin the first.

        Args:
            decisions: options to execute at most. Default: to the end of the episode.
            max_steps: base steps of the episode at which to stop.

        Returns:
            The agent, whose attributes tell the episode so far.
        """
        if self.state is None:
            self.begin()
        last = None if decisions is None else self.decisions + decisions
        while not self.done and self.decisions != last:
            if max_steps is not None and self.real_steps >= max_steps:
                break
            self._decide()
        return self

    def _decide(self) -> None:
        state = self.state
        assert state is not None
        seed = (self.seed * 1_000_003 + self.decisions) & 0x7FFFFFFF
        if self.search.ratio == 0.0 and isinstance(self.guide, ReactiveManager):
            self._execute(self.guide.act(state, seed))
            return
        self.pool.life_loss_penalty = self.greatest_reward
        if self._scale != self._wanted_scale:
            self._make_planner()
        kept = self.real is self.pool and self.decisions % self.replant_every
        if self._tree is None or not kept:
            self._tree = self.planner.plant(state, seed=seed)
        search = self._tree
        self.planner.resume(search)
        option = torch.from_numpy(self.planner.choose(search))
        self._execute(option)
        rewards = search.tree.nodes["reward"][0, : int(search.tree.num_nodes[0])]
        self.greatest_reward = max(self.greatest_reward, float(rewards.max(initial=0.0)))
        if self.guide is not None:
            self.guide.learn(search, self.greatest_reward, self.last_option)
        if not self.done and self.real is self.pool:
            self.planner.advance(search, option, self.state, seed=seed)

    def _execute(self, option: torch.Tensor) -> None:
        assert self.state is not None
        self.last_option = int(option)
        after = self.real.step(self.state.clone().set("option", option))["next"]
        self.score += float(after["score"].sum())
        self.real_steps += int(after["duration"].sum())
        self.decisions += 1
        self.options_taken[self.last_option] += 1
        self.done = bool(after["done"].any())
        self.state = after.select("emulator_state", "ram", "observation", strict=False)

    def state_dict(self) -> dict[str, Any]:
        """Return what is needed to continue from here with a new tree."""
        return {
            "progress": {
                "score": self.score,
                "real_steps": self.real_steps,
                "decisions": self.decisions,
                "done": self.done,
                "options": list(self.options_taken),
            },
            "greatest_reward": self.greatest_reward,
            "guided": self.guided,
            "state": None if self.state is None else self.state["emulator_state"].clone(),
            "guide": None if self.guide is None else self.guide.state_dict(),
            "num_calls": self.real._num_calls,  # sticky actions are drawn by their number
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from where :meth:`state_dict` was called."""
        if self.guide is not None and state_dict.get("guide") is not None:
            self.guide.load_state_dict(state_dict["guide"])
        episode = dict(state_dict["progress"])
        self.options_taken = list(episode.pop("options"))
        for name, value in episode.items():
            setattr(self, name, value)
        self.greatest_reward = float(state_dict["greatest_reward"])
        self.guided = bool(state_dict.get("guided", self.guided))
        self._make_planner()
        rows, self.state, self._tree = state_dict["state"], None, None
        if rows is not None:
            td = TensorDict({"emulator_state": rows}, [1])
            self.state = self.real.reset(td, set_state=True)
        self.real._num_calls = int(state_dict.get("num_calls", self.real._num_calls))
