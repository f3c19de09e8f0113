"""Chapter 5's experiment: tree search over options on Atari's RAM."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import CheckpointError
from tqdm import tqdm

from torchrl_hmcts.envs import AtariOptionPool, OptionWorker
from torchrl_hmcts.trainers.experiments.atari.agent import AtariAgent, AtariProgress, AtariSearch
from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig
from torchrl_hmcts.trainers.experiments.atari.goals import GoalSearch
from torchrl_hmcts.trainers.experiments.atari.guide import SearchGuide
from torchrl_hmcts.trainers.experiments.atari.learned_sources import DIAYNSource, DistilledSource
from torchrl_hmcts.trainers.experiments.atari.options import Options, WorkerSource, load_options
from torchrl_hmcts.trainers.experiments.atari.sources import (
    ActionSetSource,
    ActionSource,
    BestSource,
    GoalSource,
    RepeatSource,
)
from torchrl_hmcts.trainers.experiments.atari.trained_sources import (
    FineTunedSource,
    RetrainedSource,
)
from torchrl_hmcts.trainers.experiments.atari.trials import RememberedTrials
from torchrl_hmcts.trainers.experiments.atari.tuning import Tuned, tune_search
from torchrl_hmcts.trainers.experiments.registry import ExperimentError
from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.runs.run import Run, open_run
from torchrl_hmcts.trainers.saving.checkpoints import (
    DurableRotation,
    newest_checkpoint,
    plain_checkpoint,
    read_state,
)
from torchrl_hmcts.trainers.saving.files import left_out, write_csv
from torchrl_hmcts.trainers.saving.run_folder import versions

TOY: dict[str, Any] = {
    "frames": 20_000,
    "max_episode_frames": 2_000,
    "source": "repeat",
    "option_steps": 10,
    "ratio": 5.0,
    "skill_base_steps": 512,
}
FRAMES_PER_STEP = 4
_FRAMES_PER_POINT = 1_000 * FRAMES_PER_STEP  # of the curves: the source's 1,000 samples
_FREE = AtariConfig.FREE  # may change on the way


def run_atari(config: AtariConfig) -> dict[str, Any]:
    """Run ``hmcts train experiment=atari`` and return its figures, as in ``metrics.json``.

    Finds options, then plays episodes until the frames are spent. A run that is stopped goes on
    with ``resume=true`` from its newest checkpoint, and while it still looks for options from its
    last trial; what it would have found does not change.

    Args:
        config: see :class:`~torchrl_hmcts.trainers.experiments.atari.config.AtariConfig`.

    Returns:
        The figures; ``score_max`` is the best episode, ``score_final`` the last.

    Raises:
        ExperimentError: if there is no such game, or a checkpoint is of a run with other settings.

    Reference:
        Dissertation, chapter 5.
    """
    with open_run(config) as folder:
        return _run_atari(folder.config, folder)


def _run_atari(config: AtariConfig, folder: Run) -> dict[str, Any]:
    """Carry the experiment out in a folder that is open."""
    if config.toy:
        config = dataclasses.replace(config, **TOY)
    torch.set_num_threads(1)
    out = folder.path
    run = AtariRun(config)
    rotation = DurableRotation(out / "checkpoints")
    rotation.settings = run.settings()
    checkpoint = plain_checkpoint(run=run)
    if not config.resume:
        rotation.begin()
        _trials(out).unlink(missing_ok=True)
    else:
        with contextlib.suppress(FileNotFoundError):  # it was still looking for options
            path, state = load_run(out)
            run.load_state_dict(state)
            rotation.continue_from(path)
    save = lambda: (rotation.save(checkpoint, step=run.num_frames), None)[1]  # noqa: E731
    begin = time.perf_counter()
    with tqdm(total=config.frames, unit=" frames", unit_scale=True, disable=None) as bar:
        try:
            run.play(save, lambda: (bar.update(run.num_frames - bar.n), None)[1])
        except KeyboardInterrupt:
            print(f"\n{run.kept()}", file=sys.stderr)
            raise
        finally:
            run.close()
    metrics = {
        **run.figures(),
        "seconds_of_this_part": round(time.perf_counter() - begin, 1),
        "config": dataclasses.asdict(config),
        "versions": versions(),
    }
    with left_out("curves.csv"):
        write_csv(out / "curves.csv", ("step", "name", "value"), _curve_rows(run))
    title = f"{config.game} by planning over options, {config.protocol}"
    with folder.finish(metrics, title=title) as pictures:
        draw(run, pictures)
    print(
        f"{config.game}: {len(run.scores)} episodes, best {metrics['score_max']:g}, last "
        f"{metrics['score_final']:g}, {run.num_frames:,} frames."
    )
    return metrics


def evaluate_atari(config: AtariConfig) -> dict[str, Any]:
    """Play one episode more with the options, their length and the guide of a run.

    Args:
        config: of the run, whose folder is ``out``; changed keys (``seed``, ``ratio``,
            ``protocol``, ``max_episode_frames``, ...) change the episode. With the run's own seed
            and settings it is the run's first episode again, unless a guide has learned since.

    Returns:
        The episode (``"test"``): ``score``, ``real_frames``, ``decisions``, and the ``frames``
        emulated for it.

    Raises:
        ExperimentError: if there is no run of this game in the folder.

    Reference:
        Dissertation, chapter 5.
    """
    if config.toy:
        config = dataclasses.replace(config, **TOY)
    torch.set_num_threads(1)
    run = AtariRun(dataclasses.replace(config, options_from="", frames=1))
    checkpoint = run.take_over(Path(config.out), "out")
    before = run.num_frames
    try:
        run.play(lambda: None, lambda: None)
        row = run.scores[-1]
    finally:
        run.close()
    return {"checkpoint": checkpoint.name, "test": {**row, "frames": int(row["frames"]) - before}}


class AtariRun:
    """A run: options, how they are searched, and the episodes so far.

    Args:
        config: of the experiment.

    Attributes:
        scores: of the episodes that are over: dicts with ``frames`` (emulated so far), ``score``,
            ``real_frames`` and ``decisions``.
        best: number, score and decisions of the best episode that is over; empty before.
        options: what the source has found; None before.
        tuned: how long an option is, and PUCT's c; None before.
    """

    def __init__(self, config: AtariConfig) -> None:
        self.config = config
        self.scores: list[dict[str, float]] = []
        self.points: list[tuple[int, float]] = []  # running score against frames
        self.best: dict[str, Any] = {}
        self._decisions: list[int] = []  # options of the episode under way, in their order
        self._saved = (0, 0)  # episodes and decisions at the latest checkpoint
        self.options: Options | None = None
        self.tuned: Tuned | None = None
        self.agent: AtariAgent | None = None
        self._frames_before = 0  # of pools that are closed, and of earlier parts of the run
        self._resumed: dict[str, Any] | None = None
        self._learned: dict[str, Any] | None = None  # what another run's guide knew
        self.seconds = 0.0

    # ---------------------------------------------------------------- pools

    def make_pool(
        self,
        worker: OptionWorker,
        max_steps: int,
        *,
        sticky: bool = False,
        record: bool = False,
        seed: int | None = None,
    ) -> AtariOptionPool:
        """Make a pool of the game's emulators; to play in if sticky, else to plan."""
        config = self.config
        processes = None if config.num_processes < 0 else config.num_processes
        return AtariOptionPool(
            config.game,
            worker,
            max_steps=max_steps,
            num_processes=0 if sticky else processes,
            record=record,
            gamma=config.gamma,
            repeat_action_probability=0.25 if sticky else 0.0,
            max_frames=config.max_episode_frames,
            seed=config.seed if seed is None else seed,
        )

    @property
    def num_frames(self) -> int:
        """Frames emulated so far, for all purposes."""
        return self._frames_before + (0 if self.agent is None else self.agent.num_frames)

    # ---------------------------------------------------------------- playing

    def play(self, save: Callable[[], None], tick: Callable[[], None]) -> None:
        """Play until the frames are spent.

        Args:
            save: called where the run can go on from exactly.
            tick: called after every decision.
        """
        config = self.config
        begin = time.perf_counter()
        if self.options is None and config.options_from:
            self.take_over(Path(config.options_from), "options_from")
        if self.options is None:
            self.options = self._source().find(
                config.game, self._remembering(), seed=config.seed, log=print
            )
            self._frames_before += self.options.num_frames
        if self.tuned is None:
            self.tuned = tune_search(self.options, self._remembering(), config, log=print)
            self._frames_before += self.tuned.num_frames
        self.seconds += time.perf_counter() - begin
        agent = self._agent()
        fresh = self._resumed is None
        if self._resumed is not None:
            self._seed_episode(agent)
            agent.load_state_dict(self._resumed)
            self._resumed = None
            self._saved = len(self.scores), agent.progress.decisions
            self._frames_before -= agent.num_frames  # a console's start is no part of the run
            if agent.progress.done:  # the frames were spent then, and may be more now
                if self.num_frames >= config.frames:
                    return
                self._seed_episode(agent)
                agent.begin()
        else:
            self._frames_before -= agent.num_frames
            self._seed_episode(agent)
            agent.begin()
        if fresh:
            save()
            self._saved = len(self.scores), 0
        while True:
            begin = time.perf_counter()
            # To the next checkpoint, which is where the tree is planted anew.
            rest = config.replant_every - agent.progress.decisions % config.replant_every
            for _ in range(rest):
                done = agent.play(1).done
                self._decisions.append(agent.last_option)
                self._note_score(agent.progress)
                if done:
                    break
                tick()
            self.seconds += time.perf_counter() - begin
            progress = agent.progress
            if progress.done:
                self._end_episode(progress)
                if self.num_frames >= config.frames:
                    save()
                    return
                self._seed_episode(agent)
                agent.begin()
            save()
            self._saved = len(self.scores), agent.progress.decisions

    def kept(self) -> str:
        """Return a sentence on what the latest checkpoint holds, and what is to be played again."""
        if self.agent is None:
            return "Kept: the trials of options so far; the search for options continues with them."
        episodes, decisions = self._saved
        lost = self.agent.progress.decisions - decisions if episodes == len(self.scores) else 0
        return (
            f"Kept: {episodes} episodes and {decisions} decisions of the next. When it is resumed, "
            f"{max(0, lost)} decisions since are made again, the same ones."
        )

    def _remembering(self) -> RememberedTrials:
        """Makes pools whose trials a run that is stopped and resumed does not play again."""
        path = _trials(Path(self.config.out))
        return RememberedTrials(self.make_pool, path, self.settings())

    def take_over(self, folder: Path, key: str) -> Path:
        """Take options, their length and what a guide has learned from another run.

        What it spent on them counts.

        Args:
            folder: of the run.
            key: of the configuration that names it, for errors.

        Returns:
            The checkpoint.

        Raises:
            ExperimentError: if there is no run of this game.
            CheckpointError: if no checkpoint of it is whole.
        """
        try:
            path, other = load_run(folder)
        except FileNotFoundError as error:
            raise ExperimentError(f"{key}={folder} is no run of this experiment: {error}") from None
        if other["config"]["game"] != self.config.game:
            raise ExperimentError(
                f"{key}={folder} is a run of {other['config']['game']}, not of "
                f"{self.config.game}, whose actions are others."
            )
        saved = other["options"]
        self.options = Options(load_options(saved["saved"]), **saved)
        self.tuned = Tuned(**other["tuned"])
        if other["config"].get("guide", "none") == self.config.guide:
            self._learned = other["agent"].get("guide")
        self._frames_before += self.options.num_frames + self.tuned.num_frames
        return path

    def settings(self) -> dict[str, Any]:
        """The keys that a run must keep when it continues."""
        ours = dataclasses.asdict(self.config)
        return {k: v for k, v in ours.items() if k not in _FREE}

    def _seed_episode(self, agent: AtariAgent) -> None:
        """Give an episode a start and draws of its own, whatever was played before."""
        agent.seed = self.config.seed * 10_000 + len(self.scores)
        agent.pool.set_seed(agent.seed)
        agent.real.set_seed(self.start_seed(len(self.scores)))

    def start_seed(self, episode: int) -> int:
        """Return the seed of the pool in which an episode is played."""
        sticky = self.config.protocol == "sticky"
        return self.config.seed * 10_000 + episode + (7_654_321 if sticky else 0)

    def _note_score(self, progress: AtariProgress) -> None:
        """Note the running score at every 1,000th base step of all kinds, and where it ends."""
        frames = self.num_frames
        before = self.points[-1][0] if self.points else -1
        if progress.done or frames // _FRAMES_PER_POINT > before // _FRAMES_PER_POINT:
            self.points.append((frames, progress.score))

    def _end_episode(self, progress: AtariProgress) -> None:
        row = {
            "frames": self.num_frames,
            "score": progress.score,
            "real_frames": progress.real_steps * FRAMES_PER_STEP,
            "decisions": progress.decisions,
        }
        self.scores.append(row)
        whole = len(self._decisions) == progress.decisions  # not in one of an older version
        if whole and progress.score > self.best.get("score", -math.inf):
            number = len(self.scores) - 1
            self.best = {
                "episode": number,
                "score": progress.score,
                "decisions": list(self._decisions),
            }
        self._decisions.clear()
        print(f"episode {len(self.scores)}: {row}", flush=True)

    def _source(self) -> WorkerSource:
        config = self.config
        settings = GoalSearch(
            min_options=2, trial_steps=config.trial_steps, trial_ratio=config.trial_ratio
        )
        simple: dict[str, WorkerSource] = {
            "action_sets": ActionSetSource(settings, self.search()),
            "actions": ActionSource(settings, self.search()),
            "goals": GoalSource(settings, self.search()),
        }
        if config.source == "best":
            return BestSource(simple, settings, self.search())
        if config.source == "repeat":
            return RepeatSource()
        if config.source in simple:
            return simple[config.source]
        family, _, kind = config.source.partition("_")
        if family == "goals":
            network = DistilledSource(simple["goals"])
            if kind == "network":
                return network
            if kind == "fine_tuned":
                return FineTunedSource(network, config.skill_base_steps)
            return RetrainedSource(network, round_steps=config.trial_steps)
        skills, steps = config.num_skills, config.skill_base_steps
        if kind == "retrained":
            diayn = DIAYNSource(skills, steps)
            return RetrainedSource(diayn, round_steps=config.trial_steps, intrinsic_weight=0.1)
        return DIAYNSource(skills, steps, discriminator=kind or "state")

    def search(self) -> AtariSearch:
        """How the agent searches."""
        config = self.config
        return AtariSearch(
            ratio=config.ratio,
            tree_policy=config.tree_policy,
            c=config.c if self.tuned is None else self.tuned.c,
            rollout_options=config.rollout_options,
            leaves_per_wave=config.leaves_per_wave,
            waves_in_flight=config.waves_in_flight,
            width_novelty=config.width_novelty,
        )

    def _agent(self) -> AtariAgent:
        assert self.options is not None
        assert self.tuned is not None
        config, worker, steps = self.config, self.options.worker, self.tuned.option_steps
        pool = self.make_pool(worker, steps)
        real = None
        if config.protocol == "sticky":
            real = self.make_pool(worker, steps, sticky=True, seed=config.seed + 7_654_321)
        self.agent = AtariAgent(
            pool,
            self.search(),
            play_in=real,
            guide=self._guide(),
            replant_every=config.replant_every,
            seed=config.seed,
        )
        return self.agent

    def _guide(self) -> SearchGuide | None:
        assert self.options is not None
        if self.config.guide == "none":
            return None
        values = self.config.guide == "prior_value"
        num_options = self.options.worker.num_options
        guide = SearchGuide(num_options, values=values, seed=self.config.seed)
        if self._learned is not None:
            guide.load_state_dict(self._learned)
        return guide

    def close(self) -> None:
        """Stop the processes."""
        if self.agent is not None:
            self._frames_before = self.num_frames
            for pool in {id(p): p for p in (self.agent.pool, self.agent.real)}.values():
                pool.close()
            self.agent = None

    # ---------------------------------------------------------------- what came of it

    def figures(self) -> dict[str, Any]:
        """Return the run's figures."""
        assert self.options is not None
        assert self.tuned is not None
        config = self.config
        scores = [row["score"] for row in self.scores]
        guided = f"guide={config.guide}"
        before = self.options.num_frames + self.tuned.num_frames
        decisions = max(1, sum(int(row["decisions"]) for row in self.scores))
        return {
            "game": config.game,
            "protocol": config.protocol,
            "source": config.source if config.guide == "none" else f"{config.source}, {guided}",
            "seed": config.seed,
            "score_max": max(scores),
            "score_final": scores[-1],
            "score_mean": sum(scores) / len(scores),
            "episodes": self.scores,
            "frames": self.num_frames,
            "base_steps": self.num_frames // FRAMES_PER_STEP,
            "options": self.options.names,
            "option_steps": self.tuned.option_steps,
            "c": self.tuned.c,
            "frames_finding_options": self.options.num_frames,
            "frames_tuning": self.tuned.num_frames,
            "frames_per_decision": round((self.num_frames - before) / decisions, 1),
            "seconds": round(self.seconds, 1),
            "finding": self.options.report,
            "tuning": self.tuned.trials,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return what is needed to go on from a checkpoint, plain data and tensors."""
        assert self.options is not None
        assert self.tuned is not None
        assert self.agent is not None
        return {
            "config": self.settings(),
            "options": {
                "names": self.options.names,
                "num_frames": self.options.num_frames,
                "report": self.options.report,
                "saved": self.options.saved,
            },
            "tuned": dataclasses.asdict(self.tuned),
            "frames": self.num_frames,
            "seconds": self.seconds,
            "scores": list(self.scores),
            "points": list(self.points),
            "best": self.best,
            "decisions": list(self._decisions),
            "agent": self.agent.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a checkpoint.

        Args:
            state_dict: as :meth:`state_dict` returned it.

        Raises:
            ExperimentError: if it is of a run with other settings.
        """
        ours = dataclasses.asdict(self.config)
        theirs = state_dict["config"]
        others = [k for k, v in theirs.items() if k not in _FREE and ours.get(k, v) != v]
        if others:
            changed = ", ".join(f"{k}={ours.get(k)!r} instead of {theirs[k]!r}" for k in others)
            raise ExperimentError(
                f"The checkpoint is of a run with other settings: {changed}. Resume with the same, "
                f"or start anew in another folder."
            )
        saved = state_dict["options"]
        self.options = Options(load_options(saved["saved"]), **saved)
        self.tuned = Tuned(**state_dict["tuned"])
        self.scores = [dict(row) for row in state_dict["scores"]]
        self.points = [(int(x), float(y)) for x, y in state_dict["points"]]
        self.best = dict(state_dict.get("best", {}))
        self._decisions = [int(option) for option in state_dict.get("decisions", [])]
        self._frames_before = int(state_dict["frames"])
        self.seconds = float(state_dict["seconds"])
        self._resumed = state_dict["agent"]


def load_run(folder: Path) -> tuple[Path, dict[str, Any]]:
    """Return a run's newest whole checkpoint and what it holds, as :meth:`AtariRun.state_dict`.

    Args:
        folder: of the run; one of an older version, with ``checkpoints/run.pt``, is read too.

    Raises:
        FileNotFoundError: if there is no checkpoint.
        CheckpointError: if none is whole.
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


def draw(run: AtariRun, pictures: Pictures) -> None:
    """Draw a run's pictures.

    Args:
        run: with at least one episode.
        pictures: of its folder.
    """
    assert run.options is not None
    assert run.tuned is not None
    words = "Score of each episode against emulated frames, real and simulated."
    with pictures.one("scores.png", words) as path:
        from torchrl_hmcts.trainers.figures.atari_figures import plot_scores

        plot_scores(run.scores, path, title=run.config.game)
    if not run.best:  # of a run that was begun by an older version
        return
    with left_out("episode.gif"):
        from torchrl_hmcts.trainers.figures.atari_figures import write_atari_gif

        recorder = run.make_pool(
            run.options.worker,
            run.tuned.option_steps,
            record=True,
            sticky=run.config.protocol == "sticky",
        )
        recorder.set_seed(run.start_seed(run.best["episode"]))
        steps = 60 if run.config.toy else 450
        try:
            shown, score = write_atari_gif(
                recorder, run.best["decisions"], pictures.folder / "episode.gif", real_steps=steps
            )
        finally:
            recorder.close()
        pictures.captions["episode.gif"] = (
            f"The best episode (number {run.best['episode'] + 1}), which scored "
            f"{run.best['score']:g}: its first {shown} base steps of {FRAMES_PER_STEP} frames, "
            f"with a score of {score:g} up to there."
        )


def _trials(out: Path) -> Path:
    return out / "checkpoints" / "trials.json"


def _curve_rows(run: AtariRun) -> Iterator[tuple[int, str, float]]:
    best = float("-inf")
    for row in run.scores:
        steps = int(row["frames"]) // FRAMES_PER_STEP
        best = max(best, row["score"])
        yield steps, "score", row["score"]
        yield steps, "score_max", best
    for frames, score in run.points:
        yield frames // FRAMES_PER_STEP, "score_of_the_running_episode", score
