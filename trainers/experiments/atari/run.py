"""Chapter 5's experiment: tree search over options on Atari's RAM."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import torch

from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig
from torchrl_hmcts.trainers.experiments.atari.episodes import AtariRun, load_run, trials_file
from torchrl_hmcts.trainers.experiments.atari.kit import FRAMES_PER_STEP
from torchrl_hmcts.trainers.experiments.atari.learning import CURVE
from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.runs import console
from torchrl_hmcts.trainers.runs.run import Run, open_run
from torchrl_hmcts.trainers.saving.checkpoints import DurableRotation, plain_checkpoint
from torchrl_hmcts.trainers.saving.files import left_out, write_csv
from torchrl_hmcts.trainers.saving.run_folder import versions


def run_atari(config: AtariConfig) -> dict[str, Any]:
    """Run ``hmcts train experiment=atari`` and return its figures, as in ``metrics.json``.

    Finds options, then plays episodes until the frames are spent. A run that is stopped continues
    with ``resume=true`` from its newest checkpoint, and while it still looks for options from its
    last trial; what it would have found does not change.

    Args:
        config: see :class:`~torchrl_hmcts.trainers.experiments.atari.config.AtariConfig`.

    Returns:
        The figures; ``score_mean`` is the result, the mean of the ``episodes``, ``score_min`` and
        ``score_max`` the worst and the best of them.

    Raises:
        ExperimentError: if there is no such game, or a checkpoint is of a run with other settings.

    Reference:
        Dissertation, chapter 5.
    """
    torch.set_num_threads(1)
    with open_run(config) as folder:
        run = AtariRun(folder.config.sized())
        begin = time.perf_counter()
        _play(run, folder)
        metrics = {
            **run.figures(),
            "seconds_of_this_part": round(time.perf_counter() - begin, 1),
            "config": dataclasses.asdict(run.config),
            "versions": versions(),
        }
        with left_out("curves.csv"):
            values = ((name, step, value) for step, name, value in run.curves())
            write_csv(folder.path / "curves.csv", ("name", "base_steps", "value"), values)
        if learning := run.learning:
            with left_out("learning.csv"):
                points = ([row[name] for name in CURVE] for row in learning)
                write_csv(folder.path / "learning.csv", CURVE, points)
        title = f"{config.game} by planning over options, {config.protocol}"
        with folder.finish(metrics, title=title) as pictures:
            draw(run, pictures)
    rows = [
        ("game", config.game),
        ("who acts", metrics["acts"]),
        ("episodes", str(len(run.scores))),
        ("mean score", f"{metrics['score_mean']:g}"),
        ("least, largest", f"{metrics['score_min']:g}, {metrics['score_max']:g}"),
        ("emulated frames", f"{run.num_frames:,}"),
    ]
    print(console.table(rows))
    return metrics


def _play(run: AtariRun, folder: Run) -> None:
    """Play from the newest checkpoint on, or from the beginning."""
    rotation = DurableRotation(folder.checkpoints)
    rotation.settings = run.settings()
    checkpoint = plain_checkpoint(run=run)
    if not run.config.resume:
        rotation.begin()
        trials_file(folder.path).unlink(missing_ok=True)
    else:
        with contextlib.suppress(FileNotFoundError):  # it was still looking for options
            path, state = load_run(folder.path)
            run.load_state_dict(state)
            rotation.continue_from(path)
    with console.Bar(run.config.frames, desc="play", unit="frames") as bar:
        try:
            run.play(
                lambda: rotation.save(checkpoint, step=run.num_frames),
                lambda: bar.update(run.num_frames - bar.n),
            )
        except KeyboardInterrupt:
            print(f"\n{run.kept()}", file=sys.stderr)
            raise
        finally:
            run.close()


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
    run, checkpoint, before = _one_more(config)
    row = run.scores[-1]
    return {"checkpoint": checkpoint.name, "test": {**row, "frames": int(row["frames"]) - before}}


def show_atari(config: AtariConfig, film: Path) -> str:
    """Play one episode more of a run, write its first half minute as a GIF and tell how it went.

    Args:
        config: as in :func:`evaluate_atari`; with ``ratio`` 0 a reactive manager plays alone.
        film: the file.
    """
    run = _one_more(config)[0]
    shown, score = _film(run, film)
    row, how = run.scores[-1], "searches" if run.config.ratio else "plays without search"
    return (
        f"{run.config.game}, {run.config.protocol}: the agent {how} and scores {row['score']:g} in "
        f"{row['real_frames']:,.0f} frames; the film has the first {shown * FRAMES_PER_STEP:,} and "
        f"a score of {score:g}"
    )


def _one_more(config: AtariConfig) -> tuple[AtariRun, Path, int]:
    """Play an episode more of a run; return its checkpoint and the frames before, too."""
    torch.set_num_threads(1)
    run = AtariRun(dataclasses.replace(config.sized(), options_from="", frames=1))
    checkpoint = run.take_over(Path(config.out), "out")
    before = run.num_frames
    try:
        run.play(lambda: None, lambda: None)
    finally:
        run.close()
    return run, checkpoint, before


def _film(run: AtariRun, path: Path) -> tuple[int, float]:
    """Write the beginning of a run's best episode; return its base steps and their score."""
    from torchrl_hmcts.trainers.figures.atari_figures import write_atari_gif

    recorder = run.make_player(record=True)
    recorder.set_seed(run.kit.start_seed(run.best["episode"], sticky=run.sticky))
    try:
        return write_atari_gif(
            recorder, run.best["decisions"], path, real_steps=60 if run.config.toy else 450
        )
    finally:
        recorder.close()


def draw(run: AtariRun, pictures: Pictures) -> None:
    """Draw the pictures of a run with at least one episode."""
    words = "Score of each episode against emulated frames, real and simulated."
    with pictures.one("scores.png", words) as path:
        from torchrl_hmcts.trainers.figures.atari_figures import plot_scores

        plot_scores(run.scores, path, title=run.config.game)
    if learning := run.learning:
        words = (
            "Score of the agent with its worker frozen, against the samples it has learned from."
        )
        with pictures.one("learning.png", words) as path:
            from torchrl_hmcts.trainers.figures.atari_figures import plot_learning

            plot_learning({run.config.source: [learning]}, path, title=run.config.game)
    if not run.best:  # of a run that was begun by an older version
        return
    with left_out("episode.gif"):
        shown, score = _film(run, pictures.folder / "episode.gif")
        pictures.captions["episode.gif"] = (
            f"The best episode (number {run.best['episode'] + 1}), which scored "
            f"{run.best['score']:g}: its first {shown} base steps of {FRAMES_PER_STEP} frames, "
            f"with a score of {score:g} up to there."
        )
