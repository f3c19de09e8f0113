"""Search for good values of an experiment's keys, with Optuna; each trial is a run of its own."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.pool import NullPool  # Optuna depends on it

from torchrl_hmcts.trainers.experiments.journal import CheckedJournal
from torchrl_hmcts.trainers.experiments.loggers import observed
from torchrl_hmcts.trainers.experiments.registry import Experiment
from torchrl_hmcts.trainers.experiments.run_folder import end_record, start_record
from torchrl_hmcts.trainers.experiments.sweep_space import Choice, Dimension

_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
_SPACE = "space"  # attribute of a study


class Pruned(optuna.TrialPruned):
    """A trial that was given up since it lagged behind the others."""


@dataclass(frozen=True)
class Sweep:
    """A sweep: which experiment, what varies, what is improved, where it is kept.

    Args:
        experiment: to run.
        config: values of the keys that do not vary; ``out`` is the folder of the sweep.
        space: what varies.
        objective: figure of ``metrics.json``, nested names joined by dots; with a minus before
            it, less is better.
        storage: URL of an Optuna storage that several machines may share. Default: a journal file
            in the folder.
        prune: give up trials whose logged value ``experiment.progress`` lies below the median of
            the others at the same step.
        seed: of the sampler.

    Raises:
        ValueError: if nothing varies.
    """

    experiment: Experiment
    config: Any
    space: Sequence[Dimension]
    objective: str
    storage: str | None = None
    prune: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.space:
            raise ValueError(
                "nothing varies; give a key several values, e.g. seed=[0,1,2] or gamma=0.9..0.99."
            )

    @property
    def folder(self) -> Path:
        """Where the trials and what is said about them go."""
        return Path(self.config.out)

    def study(self) -> optuna.Study:
        """Return the study, with the trials so far.

        Raises:
            ValueError: if the storage has a sweep of another space or objective under this name.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        storage: str | BaseStorage
        if self.storage is None:
            storage = JournalStorage(CheckedJournal(self.folder / "journal.log"))
        elif self.storage.startswith("redis"):
            storage = self.storage
        else:  # no pool: its connections would stay open until they are collected
            storage = RDBStorage(self.storage, engine_kwargs={"poolclass": NullPool})
        study = optuna.create_study(
            storage=storage,
            study_name=f"{self.experiment.name}-{self.folder.name}",
            direction="minimize" if self.objective.startswith("-") else "maximize",
            load_if_exists=True,
            sampler=optuna.samplers.TPESampler(seed=self.seed, n_startup_trials=5),
            pruner=optuna.pruners.MedianPruner(n_startup_trials=4)
            if self.prune
            else optuna.pruners.NopPruner(),
        )
        described = json.loads(json.dumps(self._description()))
        before = study.user_attrs.get(_SPACE)
        if before not in (None, described):
            raise ValueError(
                f"{self.folder} has a sweep of something else: {before}. Give this one a folder "
                "of its own with out=DIR."
            )
        study.set_user_attr(_SPACE, described)
        return study

    def run(self, trials: int) -> optuna.Study:
        """Run trials until so many are finished, those of earlier calls included.

        Args:
            trials: finished ones in all.
        """
        study = self.study()
        while sum(t.state in _FINISHED for t in study.get_trials(deepcopy=False)) < trials:
            study.optimize(self.trial, n_trials=1)
        return study

    def trial(self, trial: optuna.Trial) -> float:
        """Run one trial; return its figure.

        Args:
            trial: of Optuna.

        Raises:
            optuna.TrialPruned: if it was given up.
            ValueError: if the run has no such figure.
        """
        values = {dimension.key: suggest(trial, dimension) for dimension in self.space}
        out = str(self.folder / f"trial_{trial.number:04d}")
        try:
            config = dataclasses.replace(self.config, **values, out=out)
        except ValueError as error:  # this combination makes no sense
            trial.set_user_attr("refused", str(error))
            raise optuna.TrialPruned(str(error)) from None
        from torchrl_hmcts.trainers.figures.report import machine, versions

        words = ["hmcts", "train", f"experiment={self.experiment.name}"]
        words += [f"{key}={value}" for key, value in {**values, "out": out}.items()]
        start_record(
            self.experiment.name, config, words, {"versions": versions(), "machine": machine()}
        )
        trial.set_user_attr("folder", Path(out).name)
        try:
            with observed(lambda name, value, step: self._watch(trial, name, value, step)):
                metrics = self.experiment(config)
        except Pruned:
            end_record(out, "given up")
            raise
        except BaseException:
            end_record(out, "stopped")
            raise
        end_record(out, "finished")
        return figure_of(metrics, self.objective)

    def _watch(self, trial: optuna.Trial, name: str, value: float, step: int) -> None:
        if name != self.experiment.progress:
            return
        trial.report(-value if self.objective.startswith("-") else value, step)
        if trial.should_prune():
            raise Pruned(f"{name}={value:.4g} at {step} is below the others' median.")

    def _description(self) -> dict[str, Any]:
        return {
            "experiment": self.experiment.name,
            "objective": self.objective,
            "space": [dataclasses.asdict(dimension) for dimension in self.space],
        }


def suggest(trial: optuna.Trial, dimension: Dimension) -> Any:
    """Let Optuna choose a value.

    Args:
        trial: of Optuna.
        dimension: what to choose from.
    """
    if isinstance(dimension, Choice):
        return trial.suggest_categorical(dimension.key, list(dimension.values))
    if dimension.integer:
        step = 1 if dimension.step is None else int(dimension.step)
        return trial.suggest_int(
            dimension.key, int(dimension.low), int(dimension.high), step=step, log=dimension.log
        )
    return trial.suggest_float(
        dimension.key, dimension.low, dimension.high, step=dimension.step, log=dimension.log
    )


def figure_of(metrics: Mapping[str, Any], objective: str) -> float:
    """Return a figure of a run by name; not a number counts as the worst there is.

    Args:
        metrics: of the run.
        objective: name, nested ones joined by dots, perhaps with a minus before it.

    Raises:
        ValueError: if there is none of that name.

    Example:
        >>> figure_of({"test": {"frames": {"mean": 261.0}}}, "-test.frames.mean")
        261.0
    """
    value: Any = metrics
    for part in objective.removeprefix("-").split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        numbers = sorted(name for name, number in _flat(metrics) if isinstance(number, int | float))
        raise ValueError(f"The run has no figure {objective!r}. It has: {', '.join(numbers)}.")
    worst = math.inf if objective.startswith("-") else -math.inf
    return float(value) if math.isfinite(value) else worst


def trial_rows(study: optuna.Study) -> list[dict[str, Any]]:
    """Return the trials of a study as plain values, the best first.

    Args:
        study: of a sweep.
    """
    sign = -1.0 if study.direction == optuna.study.StudyDirection.MAXIMIZE else 1.0

    def rank(trial: FrozenTrial) -> tuple[bool, float, int]:
        done = trial.state is TrialState.COMPLETE and trial.value is not None
        return (not done, sign * float(trial.value or 0.0) if done else 0.0, trial.number)

    states = {TrialState.PRUNED: "given up", TrialState.RUNNING: "running or interrupted"}
    return [
        {
            "trial": trial.number,
            "state": states.get(trial.state, trial.state.name.lower()),
            "value": trial.value if trial.state is TrialState.COMPLETE else None,
            "params": dict(trial.params),
            "folder": trial.user_attrs.get("folder", ""),
            "seconds": None if trial.duration is None else round(trial.duration.total_seconds(), 1),
            "refused": trial.user_attrs.get("refused", ""),
        }
        for trial in sorted(study.get_trials(deepcopy=False), key=rank)
    ]


def importances(study: optuna.Study) -> dict[str, float]:
    """Return how much of what sets the best trials apart lies in each key; they sum to 1.

    Args:
        study: of a sweep; empty with fewer than four trials, or if all gave the same.

    Reference:
        Watanabe et al., "PED-ANOVA", 2023, arXiv 2304.10255.
    """
    values = [t.value for t in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))]
    if len(values) < 4 or len(set(values)) < 2:
        return {}
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    try:
        found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    except (ValueError, RuntimeError):  # e.g. a key that took one value only
        return {}
    return {key: float(value) for key, value in found.items()}


def _flat(metrics: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{name}.")
        else:
            rows.append((prefix + name, value))
    return rows
