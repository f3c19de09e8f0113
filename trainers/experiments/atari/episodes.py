"""A run of the Atari agent: its options, how they are searched, and the episodes so far."""

from __future__ import annotations

import copy
import dataclasses
import math
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import CheckpointError

from torchrl_hmcts.envs import AtariOptionPool
from torchrl_hmcts.trainers.experiments.atari.agent import AtariAgent, AtariSearch
from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig
from torchrl_hmcts.trainers.experiments.atari.guide import SearchGuide
from torchrl_hmcts.trainers.experiments.atari.kit import FRAMES_PER_STEP, AtariKit
from torchrl_hmcts.trainers.experiments.atari.learning import LearningCurve
from torchrl_hmcts.trainers.experiments.atari.memory import TrialMemory
from torchrl_hmcts.trainers.experiments.atari.options import Options, has_network
from torchrl_hmcts.trainers.experiments.atari.reactive import ReactiveManager
from torchrl_hmcts.trainers.experiments.atari.sources import make_source
from torchrl_hmcts.trainers.experiments.atari.trials import GRID_SKILLS, Tuned, tune_search
from torchrl_hmcts.trainers.runs import console
from torchrl_hmcts.trainers.runs.config import ExperimentError
from torchrl_hmcts.trainers.saving.checkpoints import newest_checkpoint, read_state

CHECKPOINTS = (2_000_000, 5_000_000, 10_000_000, 40_000_000)
_REACTIVE_STEPS = 5  # of an option of a manager that practises
_PRACTICE_FRAMES = 100_000  # at a time
_PRACTICE_SEED = 1_000_003
_FRAMES_PER_POINT = 1_000 * FRAMES_PER_STEP  # of the curves: the dissertation's 1,000 samples
_HISTORY = ("scores", "points", "best", "decisions", "seconds")


class AtariRun:
    """Options, how they are searched, and the episodes so far.

    Args:
        config: of the experiment.

    Attributes:
        scores: of the episodes that are over: dicts with ``frames`` (emulated so far), ``score``,
            ``real_frames`` and ``decisions``.
        points: running score against frames, for the curves.
        best: number, score and decisions of the best episode that is over; empty before.
        options, tuned: what the source has found, and how long an option is; once it plays.
    """

    options: Options
    tuned: Tuned

    def __init__(self, config: AtariConfig) -> None:
        self._asked = config
        self.config = config = config.resolved()
        self.kit = AtariKit(
            config.game,
            gamma=config.gamma,
            max_frames=config.max_episode_frames,
            num_processes=None if config.num_processes < 0 else config.num_processes,
            seed=config.seed,
        )
        self.sticky = config.protocol == "sticky"
        self.scores: list[dict[str, float]] = []
        self.points: list[tuple[int, float]] = []
        self.best: dict[str, Any] = {}
        self.decisions: list[int] = []  # options of the episode under way, in their order
        self.seconds = 0.0
        self.agent: AtariAgent | None = None
        self._found = False
        self._saved = (0, 0)  # episodes and decisions at the latest checkpoint
        self._frames_before = 0  # of pools that are closed, and of earlier parts of the run
        self._resumed: dict[str, Any] | None = None
        self._learned: dict[str, Any] | None = None  # what another run's guide knew
        self._practice: AtariOptionPool | None = None

    @property
    def search(self) -> AtariSearch:
        """How the agent plans."""
        names = [field.name for field in dataclasses.fields(AtariSearch)]
        return AtariSearch(**{name: getattr(self.config, name) for name in names})

    @property
    def num_frames(self) -> int:
        """Frames emulated so far, for all purposes."""
        frames = self._frames_before + (0 if self.agent is None else self.agent.num_frames)
        return frames + (0 if self._practice is None else self._practice.num_frames)

    def settings(self) -> dict[str, Any]:
        """Return the keys that a run keeps when it continues."""
        return {name: getattr(self.config, name) for name in self.config.KEPT}

    # ---------------------------------------------------------------- options

    def _find_options(self) -> None:
        config = self.config
        if config.options_from:
            self.take_over(Path(config.options_from), "options_from")
            return
        memory = TrialMemory(trials_file(Path(config.out)), self.settings())
        kit = dataclasses.replace(self.kit, memory=memory)
        if config.curve_every:
            kit = dataclasses.replace(kit, curve=self._learning_curve())
        tried = []
        for number in (config.num_skills,) if config.num_skills else GRID_SKILLS:
            source = make_source(dataclasses.replace(config, num_skills=number), self.search)
            options = source.find(kit)
            if config.guide == "reactive":  # which finds out by itself what they are good for
                tuned = Tuned(config.option_steps or _REACTIVE_STEPS, config.c)
            else:
                tuned = tune_search(options.worker, kit, self.search, config)
            tried.append((options, tuned))
        self.options, self.tuned = max(tried, key=lambda pair: pair[1].best)
        for options, tuned in tried:
            if options is not self.options:  # what lost has cost frames, too
                self.options.num_frames += options.num_frames
                self.tuned.num_frames += tuned.num_frames
                self.tuned.trials += tuned.trials
        if isinstance(kit.curve, LearningCurve):
            learning = {"rows": kit.curve.rows, "test_frames": kit.curve.num_frames}
            self.options.report["learning"] = learning
        self._frames_before += self.options.num_frames + self.tuned.num_frames
        self._found = True

    def _learning_curve(self) -> LearningCurve:
        config = self.config
        return LearningCurve(
            self.kit,
            self.search,
            option_steps=config.option_steps or 10,
            every=config.curve_every,
            episodes=config.curve_episodes,
            max_steps=config.curve_steps,
        )

    def take_over(self, folder: Path, key: str) -> Path:
        """Take options, their length and what a guide has learned from another run's checkpoint,
        which is returned; what it spent on them counts. ``key`` names the folder in errors."""
        try:
            path, other = load_run(folder)
        except FileNotFoundError as error:
            raise ExperimentError(f"{key}={folder} is no run of this experiment: {error}") from None
        if other["config"]["game"] != self.config.game:
            raise ExperimentError(
                f"{key}={folder} is a run of {other['config']['game']}, not of "
                f"{self.config.game}, whose actions are others."
            )
        self._take_options(other)
        if self._asked.guide == "auto":
            guide = other["config"].get("guide", "none")
            self.config = dataclasses.replace(self._asked, guide=guide).resolved()
        if other["config"].get("guide", "none") == self.config.guide:
            self._learned = other["agent"].get("guide")
        self._frames_before += self.options.num_frames + self.tuned.num_frames
        return path

    def _take_options(self, state: dict[str, Any]) -> None:
        self.options, self.tuned = Options.from_plain(state["options"]), Tuned(**state["tuned"])
        self._found = True

    # ---------------------------------------------------------------- playing

    def play(self, save: Callable[[], object], tick: Callable[[], object]) -> None:
        """Play until the frames are spent.

        Args:
            save: called where the run can continue from exactly.
            tick: called after every decision.
        """
        begin = time.perf_counter() - self.seconds
        if not self._found:
            self._find_options()
        agent, resumed = self._make_agent(), self._resumed
        if resumed is not None:
            self._seed_episode(agent)
            agent.load_state_dict(resumed)
            self._resumed = None
            self._saved = len(self.scores), agent.decisions
        self._frames_before -= agent.num_frames  # a console's start is no part of the run
        if self._practice is not None:
            self._frames_before -= self._practice.num_frames
        if agent.done:  # nothing is under way
            if resumed is not None and self._played_enough:
                return
            self._practise(tick)
            self._begin_episode(agent)
        due = resumed is None
        while True:
            self.seconds = time.perf_counter() - begin
            if due:
                save()
                self._saved = len(self.scores), agent.decisions
            if agent.done:
                return
            agent.play(1)
            self._note(agent)
            if not agent.done:
                tick()
            else:
                self._end_episode(agent)
                if not self._played_enough:
                    self._practise(tick)
                    self._begin_episode(agent)
            due = agent.done or agent.decisions % self.config.replant_every == 0

    @property
    def _played_enough(self) -> bool:
        config = self.config
        practising = config.guide == "reactive" and config.practice > 0.0
        enough = not practising and len(self.scores) >= config.episodes
        return enough or self.num_frames >= config.frames

    def kept(self) -> str:
        """Return a sentence on what the latest checkpoint holds, and what is to be played again."""
        if self.agent is None:
            return "Kept: the trials of options so far; the search for options continues with them."
        episodes, decisions = self._saved
        lost = self.agent.decisions - decisions if episodes == len(self.scores) else 0
        return (
            f"Kept: {episodes} episodes and {decisions} decisions of the next. When it is resumed, "
            f"{max(0, lost)} decisions since are made again, the same ones."
        )

    def _make_agent(self) -> AtariAgent:
        config, worker, steps = self.config, self.options.worker, self.tuned.option_steps
        guide: SearchGuide | ReactiveManager | None = None
        if config.guide == "reactive":
            guide = ReactiveManager(worker.num_options, gamma=config.gamma, seed=config.seed)
            self._practice = self.kit.make_pool(
                worker, steps, sticky=self.sticky, end_on_life_loss=True
            )
        elif config.guide != "none":
            values = config.guide == "prior_value"
            guide = SearchGuide(worker.num_options, values=values, seed=config.seed)
        if guide is not None and self._learned is not None:
            guide.load_state_dict(self._learned)
        self.agent = AtariAgent(
            self.kit.make_pool(
                worker, steps, split="test", sticky=self.sticky and config.guide == "reactive"
            ),
            dataclasses.replace(self.search, c=self.tuned.c),
            play_in=self.make_player() if self.sticky else None,
            guide=guide,
            replant_every=config.replant_every,
            seed=config.seed,
        )
        return self.agent

    def make_player(self, *, record: bool = False) -> AtariOptionPool:
        """Make a pool in which the scored episodes begin."""
        worker, steps = self.options.worker, self.tuned.option_steps
        kit = dataclasses.replace(self.kit, num_processes=0) if self.sticky else self.kit
        return kit.make_pool(worker, steps, split="test", sticky=self.sticky, record=record)

    def close(self) -> None:
        """Stop the processes."""
        if self.agent is not None:
            self._frames_before = self.num_frames
            self.agent.close()
            self.agent = None
        if self._practice is not None:
            self._practice.close()
            self._practice = None

    def _seed_episode(self, agent: AtariAgent) -> None:
        """Give an episode a start and draws of its own, independent of those before."""
        number = len(self.scores)
        agent.seed = self.kit.start_seed(number)
        agent.pool.set_seed(agent.seed)
        agent.real.set_seed(self.kit.start_seed(number, sticky=self.sticky))

    def _practise(self, tick: Callable[[], object]) -> None:
        """Let a manager that practises do so until that took its share of the frames so far."""
        manager, pool, share = self.agent and self.agent.guide, self._practice, self.config.practice
        if not isinstance(manager, ReactiveManager) or pool is None:
            return
        pool.set_seed(_PRACTICE_SEED + self.kit.start_seed(len(self.scores), sticky=self.sticky))
        before = manager.practised
        rest = self.num_frames - before
        while (due := rest * share / (1.0 - share) - manager.practised) > 0:
            manager.practise(pool, min(math.ceil(due), _PRACTICE_FRAMES))
            tick()
        if manager.scores and manager.practised > before:
            mean = sum(manager.scores) / len(manager.scores)
            console.note(f"Practice: {manager.practised:,} frames, latest episodes {mean:.1f}")

    def _begin_episode(self, agent: AtariAgent) -> None:
        self._seed_episode(agent)
        agent.begin(self._guides_next())

    def _guides_next(self) -> bool:
        """Return whether a manager that practises guides the next episode: a bandit's choice."""
        if self.config.guide != "reactive" or self.config.ratio == 0.0:
            return True
        arms = {
            guided: [r["score"] for r in self.scores if r.get("guided", True) == guided]
            for guided in (False, True)
        }
        return choose_arm(arms[False], arms[True]) == 1

    def _note(self, agent: AtariAgent) -> None:
        """Note the decision, and the running score at every 1,000th base step and at the end."""
        self.decisions.append(agent.last_option)
        frames = self.num_frames
        before = self.points[-1][0] if self.points else -1
        if agent.done or frames // _FRAMES_PER_POINT > before // _FRAMES_PER_POINT:
            self.points.append((frames, agent.score))

    def _end_episode(self, agent: AtariAgent) -> None:
        """Note an episode that is over."""
        whole = len(self.decisions) == agent.decisions  # not in one of an older version
        if whole and agent.score > self.best.get("score", -math.inf):
            episode = {"episode": len(self.scores), "score": agent.score}
            self.best = {**episode, "decisions": self.decisions}
        self.decisions = []
        row = {
            "frames": self.num_frames,
            "score": agent.score,
            "real_frames": agent.real_steps * FRAMES_PER_STEP,
            "decisions": agent.decisions,
        }
        if self.config.guide == "reactive":
            row["guided"] = agent.guided
        self.scores.append(row)
        console.note(
            f"Episode {len(self.scores)}: score {agent.score:g} in {row['real_frames']:,} frames, "
            f"{row['frames']:,} emulated so far"
        )

    # ---------------------------------------------------------------- results

    def figures(self) -> dict[str, Any]:
        """Return the run's figures."""
        config, options, tuned = self.config, self.options, self.tuned
        counted = self.scores[-config.episodes :]
        scores = [row["score"] for row in counted]
        decisions = max(1, sum(int(row["decisions"]) for row in self.scores))
        spent = self.num_frames - options.num_frames - tuned.num_frames
        real = sum(int(row["real_frames"]) for row in self.scores)
        guided = "" if config.guide == "none" else f", guide={config.guide}"
        return {
            "game": config.game,
            "protocol": config.protocol,
            "source": config.source + guided,
            "acts": "network" if has_network(options.worker) else "rules",
            "seed": config.seed,
            "score_max": max(scores),
            "score_min": min(scores),
            "score_final": scores[-1],
            "score_mean": sum(scores) / len(scores),
            **({"score_at": score_at(self.scores, config.episodes)} if self.sticky else {}),
            "episodes": self.scores,
            "frames": self.num_frames,
            "base_steps": self.num_frames // FRAMES_PER_STEP,
            "options": options.names,
            "option_steps": tuned.option_steps,
            "c": tuned.c,
            "frames_finding_options": options.num_frames,
            "frames_tuning": tuned.num_frames,
            "frames_per_decision": round(spent / decisions, 1),
            "simulated_per_real": round((spent - real) / max(1, real), 1),
            "seconds": round(self.seconds, 1),
            "finding": options.report,
            "tuning": tuned.trials,
        }

    @property
    def learning(self) -> list[dict[str, Any]]:
        """Points of the learning curve, see :class:`LearningCurve`."""
        rows: list[dict[str, Any]] = self.options.report.get("learning", {}).get("rows", [])
        return rows

    def curves(self) -> Iterator[tuple[int, str, float]]:
        """Yield base steps of all kinds, name and value of each point of the curves."""
        best = -math.inf
        for row in self.scores:
            steps = int(row["frames"]) // FRAMES_PER_STEP
            best = max(best, row["score"])
            yield steps, "score", row["score"]
            yield steps, "score_max", best
        for frames, score in self.points:
            yield frames // FRAMES_PER_STEP, "score_of_the_running_episode", score

    def state_dict(self) -> dict[str, Any]:
        """Return what is needed to continue from a checkpoint, plain data and tensors."""
        assert self.agent is not None
        return {
            "config": self.settings(),
            "options": self.options.plain(),
            "tuned": dataclasses.asdict(self.tuned),
            "frames": self.num_frames,
            **{name: copy.copy(getattr(self, name)) for name in _HISTORY},
            "agent": self.agent.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a checkpoint; one of a run with other settings is refused."""
        ours, theirs = self.settings(), state_dict["config"]
        others = [name for name in ours if theirs.get(name, ours[name]) != ours[name]]
        if others:
            changed = ", ".join(f"{k}={ours[k]!r} instead of {theirs[k]!r}" for k in others)
            raise ExperimentError(
                f"The checkpoint is of a run with other settings: {changed}. Resume with the same, "
                f"or begin another run in another folder."
            )
        self._take_options(state_dict)
        for name in _HISTORY:  # an older version kept less
            setattr(self, name, copy.copy(state_dict.get(name, getattr(self, name))))
        self._frames_before = int(state_dict["frames"])
        self._resumed = state_dict["agent"]


def choose_arm(*scores: Sequence[float], last: int = 10) -> int:
    r"""Return the arm that UCB1 pulls next, an untried one first.

    .. math:: \arg\max_i \frac{\bar x_i - \min x}{\max x - \min x} + \sqrt{\frac{\ln n}{2 n_i}}

    with the mean of the ``last`` scores of an arm, since what it plays with learns meanwhile.

    Reference:
        Auer, Cesa-Bianchi and Fischer, "Finite-time analysis of the multiarmed bandit problem",
        2002.

    Example:
        >>> choose_arm([1.0, 2.0], []), choose_arm([1.0] * 9, [5.0] * 9)
        (1, 1)
    """
    for arm, own in enumerate(scores):
        if not own:
            return arm
    every = [x for own in scores for x in own]
    low, spread = min(every), max(max(every) - min(every), 1e-9)

    def bound(arm: int) -> float:
        own = scores[arm]
        mean = (sum(own[-last:]) / len(own[-last:]) - low) / spread
        return mean + math.sqrt(math.log(len(every)) / (2 * len(own)))

    return max(range(len(scores)), key=bound)


def score_at(episodes: Sequence[Mapping[str, float]], last: int = 10) -> dict[str, float]:
    """Return the mean score of the ``last`` episodes over by 2, 5, 10 and 40 million frames.

    A number of frames that the run has not reached is left out.

    Example:
        >>> score_at([{"frames": 1e6, "score": 2.0}, {"frames": 4e6, "score": 6.0}], last=1)
        {'2000000': 2.0}
    """
    found = {}
    for frames in CHECKPOINTS:
        scores = [row["score"] for row in episodes if row["frames"] <= frames][-last:]
        if scores and episodes[-1]["frames"] >= frames:  # the run went so far
            found[str(frames)] = sum(scores) / len(scores)
    return found


def trials_file(folder: Path) -> Path:
    """Return the file of a run's trials, which are not played again."""
    return folder / "checkpoints" / "trials.json"


def load_run(folder: Path) -> tuple[Path, dict[str, Any]]:
    """Return a run's newest whole checkpoint and what it holds, as :meth:`AtariRun.state_dict`.

    A run of an older version, with ``checkpoints/run.pt``, is read too.
    """
    old = folder / "checkpoints" / "run.pt"
    try:
        path = newest_checkpoint(folder / "checkpoints")
        return path, read_state(path, "run")
    except FileNotFoundError:
        if not old.is_file():
            raise
    try:
        with zipfile.ZipFile(old) as archive:  # torch.load does not compare the checksums
            bad = archive.testzip()
        if bad is not None:
            raise ValueError(f"{bad} differs from its checksum")
        return old, torch.load(old, weights_only=True)
    except Exception as error:  # damage takes any form
        raise CheckpointError(f"The checkpoint {str(old)!r} is damaged ({error}).") from error
