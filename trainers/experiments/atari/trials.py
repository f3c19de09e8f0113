"""Short planned episodes in which options and settings are compared."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any

from torchrl_hmcts.envs import OptionWorker
from torchrl_hmcts.trainers.experiments.atari.agent import AtariAgent, AtariSearch
from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig
from torchrl_hmcts.trainers.experiments.atari.kit import AtariKit
from torchrl_hmcts.trainers.experiments.atari.memory import Trial
from torchrl_hmcts.trainers.experiments.atari.options import plain_worker

_OPTION_STEPS = (10, 5, 20, 30)
GRID_SKILLS, _GRID_STEPS = (3, 4, 5), (10, 20, 30)  # the dissertation's grid


def play_trial(
    kit: AtariKit,
    worker: OptionWorker,
    search: AtariSearch,
    *,
    option_steps: int,
    real_steps: int,
    seed: int,
    start: int | None = None,
) -> Trial:
    """Plan and play a short episode, from the kit's start if ``start`` names no seed of another;
    what the kit's memory knows is not played."""
    key, memory = None, kit.memory
    if memory is not None:
        # Older versions had two settings more, and their trials are still known.
        how = {**dataclasses.asdict(search), "reuse": True, "life_loss_penalty": None}
        try:
            parts = [plain_worker(worker), how, option_steps, real_steps, seed, start]
            key = json.dumps(parts, sort_keys=True)
        except TypeError:  # a network is known by its weights, which are no key; or it is your own
            key = None
        known = None if key is None else memory.recall(key)
        if known is not None:
            return known
    pool = kit.make_pool(worker, option_steps)
    try:
        if start is not None:
            pool.set_seed(start)
        agent = AtariAgent(pool, search, seed=seed).play(max_steps=real_steps)
        trial = Trial(agent.score, agent.real_steps, pool.num_frames)
    finally:
        pool.close()
    if memory is not None and key is not None:
        memory.remember(key, trial)
    return trial


@dataclass
class Tuned:
    """Base steps of an option and PUCT's weight of exploration, the frames emulated to find them,
    and settings and score of each trial."""

    option_steps: int
    c: float
    num_frames: int = 0
    trials: list[dict[str, float]] = field(default_factory=list)

    @property
    def best(self) -> tuple[float, float]:
        """Score of the best trial, and how long it lived."""
        return max(((t["score"], t["real_steps"]) for t in self.trials), default=(0.0, 0.0))


def tune_search(
    worker: OptionWorker,
    kit: AtariKit,
    search: AtariSearch,
    config: AtariConfig,
) -> Tuned:
    """Try settings in short episodes and return the best by the game's score.

    A trial has twice the config's ``trial_steps`` and its ``ratio``, at most 10, and plans by PUCT.
    The lengths 10, 5, 20 and 30 are tried (10, 20 and 30 where the number of skills is searched
    for, too), or lengths from 4 to 40 and c from 0.5 to 4 as Optuna's TPE draws them; nothing where
    the config names both.
    """
    tuned = Tuned(config.option_steps or _OPTION_STEPS[0], config.c)
    lengths = _GRID_STEPS if config.num_skills == 0 else _OPTION_STEPS[: config.tune_trials]
    if config.option_steps:
        if config.num_skills:
            return tuned
        lengths = (config.option_steps,)
    short = dataclasses.replace(search, ratio=min(config.ratio, 10.0), tree_policy="puct")

    def trial(option_steps: int, c: float) -> float:
        played = play_trial(
            kit,
            worker,
            dataclasses.replace(short, c=c),
            option_steps=option_steps,
            real_steps=2 * config.trial_steps,
            seed=config.seed,
        )
        tuned.num_frames += played.num_frames
        row = {"option_steps": option_steps, "c": c, "score": played.score}
        if config.num_skills == 0:
            row["num_skills"] = worker.num_options
        tuned.trials.append({**row, "real_steps": played.real_steps})
        kit.log(f"trial: {tuned.trials[-1]}")
        return played.rank

    if config.tune_with == "grid":
        for option_steps in lengths:
            trial(option_steps, config.c)
    else:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)

        def objective(suggested: Any) -> float:
            steps = suggested.suggest_int("option_steps", 4, 40, log=True)
            return trial(steps, suggested.suggest_float("c", 0.5, 4.0, log=True))

        sampler = optuna.samplers.TPESampler(seed=config.seed)
        study = optuna.create_study(direction="maximize", sampler=sampler)
        study.enqueue_trial({"option_steps": _OPTION_STEPS[0], "c": config.c})
        study.optimize(objective, n_trials=config.tune_trials)
    best = max(tuned.trials, key=lambda row: (row["score"], row["real_steps"]))
    tuned.option_steps, tuned.c = int(best["option_steps"]), float(best["c"])
    return tuned
