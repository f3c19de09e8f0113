"""Search for good values of an experiment's keys, with Optuna; each trial is a run of its own."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, OperationalError
from sqlalchemy.pool import NullPool  # Optuna depends on it

from torchrl_hmcts.trainers.experiments.registry import Experiment
from torchrl_hmcts.trainers.runs.config import home
from torchrl_hmcts.trainers.runs.journal import CheckedJournal
from torchrl_hmcts.trainers.runs.loggers import observed
from torchrl_hmcts.trainers.runs.run import next_free, open_run, run_files
from torchrl_hmcts.trainers.runs.sweep_space import Choice, Dimension
from torchrl_hmcts.trainers.saving.run_folder import flat, read_run

_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
_SPACE = "space"  # attribute of a study
_NOT_FIXED = ("out", "resume", "overwrite", "logger")  # may differ from one call to the next


class Pruned(optuna.TrialPruned):
    """A trial that was given up since it lagged behind the others."""

    run_status = "given up"  # in its run.json


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
        self._check_folder()
        self.folder.mkdir(parents=True, exist_ok=True)
        study = self._open()
        described = json.loads(json.dumps(self._description()))
        before = study.user_attrs.get(_SPACE)
        if before is not None:
            known = {key: value for key, value in described.items() if key in before}
            if before != known:
                differing = [key for key in before if before[key] != known.get(key)]
                raise ValueError(
                    f"{self.folder} has a sweep of something else: "
                    f"{', '.join(f'{key} {before[key]}' for key in differing)}. Give this one a "
                    "folder of its own with out=DIR."
                )
        study.set_user_attr(_SPACE, {**described, **(before or {})})
        return study

    def _check_folder(self) -> None:
        """Refuse a folder that holds something else than a sweep."""
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"out={self.folder} is a file; name a folder.")
        there = run_files(self.folder)
        if there and not {"journal.log", "sweep.json"} & set(there):
            raise ValueError(
                f"{self.folder} holds what is no sweep ({', '.join(there[:4])}). Choose another "
                f"folder, e.g. out={next_free(str(self.folder))}."
            )

    def _open(self) -> optuna.Study:
        """The study, of the name under which the folder knows it, wherever the folder is now."""
        try:
            storage = self._storage()
            name = self._study_name(storage)
            return optuna.create_study(
                storage=storage,
                study_name=name,
                direction="minimize" if self.objective.startswith("-") else "maximize",
                load_if_exists=True,
                pruner=optuna.pruners.MedianPruner(n_startup_trials=4)
                if self.prune
                else optuna.pruners.NopPruner(),
            )
        except (ArgumentError, OperationalError, NoSuchModuleError) as error:
            raise ValueError(
                f"storage={self.storage} cannot be opened ({str(error).splitlines()[0]}). Give a "
                "URL, e.g. storage=sqlite:///runs/trials.db."
            ) from None

    def _storage(self) -> BaseStorage:
        if self.storage is None:
            return JournalStorage(CheckedJournal(self.folder / "journal.log"))
        if self.storage.startswith("redis"):
            return optuna.storages.get_storage(self.storage)
        scheme, slashes, place = self.storage.partition(":///")
        url = f"{scheme}{slashes}{home(place)}"
        # No pool: its connections would stay open until they are collected.
        return RDBStorage(url, engine_kwargs={"poolclass": NullPool})

    def _study_name(self, storage: BaseStorage) -> str:
        """The folder may have been renamed since its study was named after it."""
        names = optuna.get_all_study_names(storage)
        if self.storage is None and names:
            return names[0]  # a journal holds one
        noted = ""
        if (self.folder / "sweep.json").is_file():
            with contextlib.suppress(ValueError, OSError):
                noted = json.loads((self.folder / "sweep.json").read_text()).get("study", "")
        return noted if noted in names else f"{self.experiment.name}-{self.folder.name}"

    def run(self, trials: int) -> optuna.Study:
        """Run trials until so many are finished, those of earlier calls included.

        A trial that was stopped, or whose process died, is continued first.

        Args:
            trials: finished ones in all.
        """
        study = self.study()
        self._take_up(study)
        while sum(t.state in _FINISHED for t in study.get_trials(deepcopy=False)) < trials:
            study.optimize(self.trial, n_trials=1)
        return study

    def _take_up(self, study: optuna.Study) -> None:
        """Queue the trials that were stopped, in their folders."""
        latest: dict[str, FrozenTrial] = {}
        for trial in study.get_trials(deepcopy=False):
            for key in ("continues", "folder"):
                if key in trial.user_attrs:
                    latest[trial.user_attrs[key]] = trial
        for folder, trial in latest.items():
            if trial.state not in (TrialState.RUNNING, TrialState.FAIL):
                continue
            path = self.folder / folder
            try:
                status = read_run(path).status
            except ValueError:  # on another machine
                continue
            if status not in ("stopped", "interrupted"):
                continue
            if trial.state is TrialState.RUNNING:
                study.tell(trial.number, state=TrialState.FAIL)
            study.enqueue_trial(trial.params, user_attrs={"continues": folder})

    def trial(self, trial: optuna.Trial) -> float:
        """Run one trial; return its figure.

        Args:
            trial: of Optuna.

        Raises:
            optuna.TrialPruned: if it was given up.
            ValueError: if the run has no such figure.
        """
        # By the trial's number: neither a sweep that is continued nor another process on the same
        # storage draws the same values again.
        words = [self.seed, trial.number]
        seed = int(np.random.SeedSequence(words).generate_state(1)[0])
        trial.study.sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=5)
        values = {dimension.key: suggest(trial, dimension) for dimension in self.space}
        before = trial.user_attrs.get("continues", "")
        resume = bool(before) and hasattr(self.config, "resume")
        out = str(self.folder / (before if resume else f"trial_{trial.number:04d}"))
        try:
            config = dataclasses.replace(self.config, **values, out=out)
        except ValueError as error:  # this combination makes no sense
            trial.set_user_attr("refused", str(error))
            raise optuna.TrialPruned(str(error)) from None
        if resume:
            config = dataclasses.replace(config, resume=True)
        command = ["hmcts", "train", f"experiment={self.experiment.name}"]
        command += [f"{key}={value}" for key, value in {**values, "out": out}.items()]
        opened = open_run(
            config, experiment=self.experiment.name, command=command, fresh=not resume
        )
        with opened as run:
            trial.set_user_attr("folder", run.path.name)
            with observed(lambda name, value, step: self._watch(trial, name, value, step)):
                metrics = self.experiment(run.config)
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
            "fixed": {
                field.name: getattr(self.config, field.name)
                for field in dataclasses.fields(self.config)
                if field.name not in (*_NOT_FIXED, *(dimension.key for dimension in self.space))
                and getattr(self.config, field.name) != field.default
            },
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
        numbers = sorted(name for name, number in flat(metrics) if isinstance(number, int | float))
        raise ValueError(f"The run has no figure {objective!r}. It has: {', '.join(numbers)}.")
    worst = math.inf if objective.startswith("-") else -math.inf
    return float(value) if math.isfinite(value) else worst


def trial_rows(study: optuna.Study) -> list[dict[str, Any]]:
    """Return the trials of a study as plain values, the best first.

    Args:
        study: of a sweep.
    """
    sign = -1.0 if study.direction == optuna.study.StudyDirection.MAXIMIZE else 1.0

    def known(trial: FrozenTrial) -> bool:  # a figure that was not finite came as the worst
        return trial.value is not None and math.isfinite(trial.value)

    def rank(trial: FrozenTrial) -> tuple[bool, float, int]:
        done = trial.state is TrialState.COMPLETE and known(trial)
        return (not done, sign * float(trial.value or 0.0) if done else 0.0, trial.number)

    states = {TrialState.PRUNED: "given up", TrialState.RUNNING: "running or interrupted"}
    return [
        {
            "trial": trial.number,
            "state": states.get(trial.state, trial.state.name.lower()),
            "value": trial.value if trial.state is TrialState.COMPLETE and known(trial) else None,
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
