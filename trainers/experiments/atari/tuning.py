"""How long an option lasts, and how much a search explores: tried out per game."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from torchrl_hmcts.envs import AtariOptionPool, OptionWorker
from torchrl_hmcts.trainers.experiments.atari.agent import AtariSearch
from torchrl_hmcts.trainers.experiments.atari.options import Options
from torchrl_hmcts.trainers.experiments.atari.trials import play_trial

OPTION_STEPS = (10, 5, 20, 30)


class TuningConfig(Protocol):
    """What of a configuration tuning reads."""

    option_steps: int
    tune_trials: int
    tune_with: str
    ratio: float
    rollout_options: int
    leaves_per_wave: int
    waves_in_flight: int
    width_novelty: bool
    c: float
    trial_steps: int
    seed: int


@dataclass
class Tuned:
    """What came of tuning.

    Attributes:
        option_steps: base steps of an option.
        c: PUCT's weight of exploration.
        num_frames: frames emulated on the way.
        trials: settings and score of each trial.

    Example:
        >>> Tuned(option_steps=10, c=2.0).num_frames
        0
    """

    option_steps: int
    c: float
    num_frames: int = 0
    trials: list[dict[str, float]] = field(default_factory=list)


def tune_search(
    options: Options,
    make_pool: Callable[[OptionWorker, int], AtariOptionPool],
    config: TuningConfig,
    *,
    log: Callable[[str], None],
) -> Tuned:
    """Try settings in short episodes and return the best by the game's score.

    A trial has twice the config's ``trial_steps`` and its ``ratio``, at most 10. With ``"grid"``
    the lengths 10, 5, 20 and 30 are tried; with ``"optuna"`` lengths from 4 to 40 and c from 0.5 to
    4 are drawn by TPE. Nothing is tried where the config names a length.

    Args:
        options: what to plan over.
        make_pool: ``make_pool(worker, max_steps)``.
        config: what to try.
        log: told of every trial.

    Raises:
        ImportError: if optuna is asked for and not installed.
    """
    if config.option_steps:
        return Tuned(config.option_steps, config.c)
    tuned = Tuned(OPTION_STEPS[0], config.c)

    def trial(option_steps: int, c: float) -> float:
        search = AtariSearch(
            ratio=min(config.ratio, 10.0),
            c=c,
            rollout_options=config.rollout_options,
            leaves_per_wave=config.leaves_per_wave,
            waves_in_flight=config.waves_in_flight,
            width_novelty=config.width_novelty,
        )
        played = play_trial(
            make_pool,
            options.worker,
            search,
            option_steps=option_steps,
            real_steps=2 * config.trial_steps,
            seed=config.seed,
        )
        tuned.num_frames += played.num_frames
        row = {"option_steps": option_steps, "c": c, "score": played.score}
        row["real_steps"] = played.real_steps
        tuned.trials.append(row)
        log(f"trial: {row}")
        return played.score + 1e-6 * played.real_steps  # ties go to who lived longer

    if config.tune_with == "grid":
        for option_steps in OPTION_STEPS[: config.tune_trials]:
            trial(option_steps, config.c)
    else:
        _with_optuna(trial, config)
    best = max(tuned.trials, key=lambda row: (row["score"], row["real_steps"]))
    tuned.option_steps, tuned.c = int(best["option_steps"]), float(best["c"])
    return tuned


def _with_optuna(trial: Callable[[int, float], float], config: TuningConfig) -> None:
    try:
        import optuna
    except ImportError as error:
        raise ImportError(
            "tune_with=optuna needs optuna: pip install optuna. Without it use tune_with=grid."
        ) from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)

    def objective(suggested: Any) -> float:
        steps = suggested.suggest_int("option_steps", 4, 40, log=True)
        return trial(steps, suggested.suggest_float("c", 0.5, 4.0, log=True))

    study = optuna.create_study(
        direction="maximize", sampler=optuna.samplers.TPESampler(seed=config.seed)
    )
    study.enqueue_trial({"option_steps": OPTION_STEPS[0], "c": config.c})
    study.optimize(objective, n_trials=config.tune_trials)
    assert math.isfinite(study.best_value)
