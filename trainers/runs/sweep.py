"""Search for good values of an experiment's keys, with Optuna; each trial is a run of its own."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution
from optuna.distributions import FloatDistribution as Float
from optuna.distributions import IntDistribution as Int
from optuna.storages import BaseStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, OperationalError  # Optuna's

from torchrl_hmcts.trainers.runs.config import (
    RunConfig,
    key_kinds,
    parse_overrides,
    read_value,
)
from torchrl_hmcts.trainers.runs.loggers import observed
from torchrl_hmcts.trainers.runs.run import next_free, open_run, run_files
from torchrl_hmcts.trainers.saving.files import digest
from torchrl_hmcts.trainers.saving.run_folder import flat, read_run

Space = dict[str, BaseDistribution]
_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
_CHECKSUM = "checksum"
_SPACE = "space"  # attribute of a study
_NOT_FIXED = ("out", "resume", "overwrite", "logger")  # may differ from one call to the next


class Pruned(optuna.TrialPruned):
    """A trial that was given up since it lagged behind the others."""

    run_status = "given up"  # in its run.json


def parse_space(config_class: type, words: Sequence[str]) -> tuple[Space, list[str]]:
    """Take the keys that are varied out of the words of a sweep."""
    types = key_kinds(config_class)
    space: Space = {}
    fixed = []
    for word in words:
        key, _, value = word.partition("=")
        if key in ("resume", "overwrite"):
            raise ValueError(f"{key} is for hmcts train; the same command continues a sweep.")
        if key in space:
            raise ValueError(f"{key} is given twice.")
        if key in types and value.startswith("[") and value.endswith("]"):
            items = [item.strip() for item in value[1:-1].split(",") if item.strip()]
            if len(items) < 2:
                raise ValueError(f"{word} leaves nothing to choose; give two values or more.")
            configs: list[Any] = [
                parse_overrides(config_class, [f"{key}={item}"]) for item in items
            ]
            space[key] = CategoricalDistribution([getattr(config, key) for config in configs])
        elif ".." in value and types.get(key) in ("int", "float"):
            space[key] = _range(key, value, types[key])
        else:
            fixed.append(word)
    return space, fixed


def _range(key: str, value: str, kind: str) -> Int | Float:
    ends, _, how = value.partition(":")
    try:
        low, high = (read_value(key, end, kind) for end in ends.split(".."))
        step = read_value(key, how, kind) if how not in ("", "log") else None
    except ValueError:
        kinds = "whole numbers" if kind == "int" else "numbers"
        raise ValueError(
            f"{key}={value} is no range of {kinds}, e.g. {key}=1..10, {key}=1..10:log or "
            f"{key}=1..10:2 (in steps of 2)."
        ) from None
    if not (low < high and math.isfinite(high - low)) or (step is not None and step > high - low):
        raise ValueError(f"{key}={value} leaves nothing to choose.")
    if key == "seed":
        RunConfig(seed=low), RunConfig(seed=high)  # raise
    try:
        if kind == "int":
            return Int(low, high, log=how == "log", step=1 if step is None else step)
        return Float(low, high, log=how == "log", step=step)
    except ValueError as error:  # of Optuna, e.g. a logarithm of 0
        raise ValueError(f"{key}={value}: {error}") from None


class CheckedJournal(JournalFileBackend):
    """Optuna's journal file, from which a sweep continues, checked when it is opened.

    A last line that is not whole is cut off, and a line on stderr says so; the journal as it was is
    kept as ``journal.log.damaged``. Any other damage is refused.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(str(path))
        self._lock.acquire()
        try:
            _check(Path(path))
        finally:
            self._lock.release()

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        super().append_logs([{**log, _CHECKSUM: digest(log)} for log in logs])

    def read_logs(self, log_number_from: int) -> Iterator[dict[str, Any]]:  # type: ignore[override]
        for log in super().read_logs(log_number_from):
            log.pop(_CHECKSUM, None)
            yield log


def _check(path: Path) -> None:
    lines = path.read_bytes().splitlines(keepends=True)
    for number, line in enumerate(lines, 1):
        try:
            log = json.loads(line)
            if line.endswith(b"\n") and log.pop(_CHECKSUM, None) in (None, digest(log)):
                continue
            reason = "differs from its checksum"
        except (ValueError, AttributeError, RecursionError) as error:
            reason = f"cannot be read: {error}"
        if number < len(lines):
            raise ValueError(
                f"{path} is damaged: line {number} {reason}. Restore it from a backup, or choose "
                "another folder with out=DIR."
            )
        kept = Path(shutil.copy2(path, f"{path}.damaged"))
        words = f"its last line is not whole and is left out; as it was: {kept.name}"
        print(f"{path}: {words}.", file=sys.stderr)
        os.truncate(path, sum(map(len, lines[:-1])))


@dataclass(frozen=True)
class Sweep:
    """A sweep: which experiment, what varies, what is improved, where it is kept."""

    name: str
    run: Callable[[Any], Mapping[str, Any]]
    config: Any
    space: Space
    objective: str
    progress: str = ""
    storage: str | None = None

    def __post_init__(self) -> None:
        if not self.space:
            raise ValueError(
                "nothing varies; give a key several values, e.g. seed=[0,1,2] or gamma=0.9..0.99."
            )

    @property
    def folder(self) -> Path:
        """The folder of the trials and of what is noted of them."""
        return Path(self.config.out)

    def study(self) -> optuna.Study:
        """Return the study, with the trials so far."""
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"out={self.folder} is a file; name a folder.")
        there = run_files(self.folder)
        if there and not {"journal.log", "sweep.json"} & set(there):
            raise ValueError(
                f"{self.folder} holds files that are not a sweep's ({', '.join(there[:4])}). "
                f"Choose another folder, e.g. out={next_free(str(self.folder))}."
            )
        self.folder.mkdir(parents=True, exist_ok=True)
        study = self._open()
        described = json.loads(json.dumps(self._description()))
        before = study.user_attrs.get(_SPACE, {})
        differing = [key for key in before if before[key] != described.get(key)]
        if differing:
            raise ValueError(
                f"{self.folder} holds another sweep: "
                f"{', '.join(f'{key} {before[key]}' for key in differing)}. Choose another "
                "folder with out=DIR."
            )
        study.set_user_attr(_SPACE, {**described, **before})
        return study

    def _open(self) -> optuna.Study:
        """The study, of the name under which the folder knows it, wherever the folder is now."""
        pruner = optuna.pruners.MedianPruner(n_startup_trials=4)
        try:
            storage = self._storage()
            return optuna.create_study(
                storage=storage,
                study_name=self._study_name(storage),
                direction="minimize" if self.objective.startswith("-") else "maximize",
                load_if_exists=True,
                pruner=pruner if self.progress else optuna.pruners.NopPruner(),
            )
        except (ArgumentError, OperationalError, NoSuchModuleError) as error:
            raise ValueError(
                f"storage={self.storage} cannot be opened ({str(error).splitlines()[0]}). Give a "
                "URL, e.g. storage=sqlite:///runs/trials.db."
            ) from None

    def _storage(self) -> BaseStorage:
        if self.storage is None:
            return JournalStorage(CheckedJournal(self.folder / "journal.log"))
        return optuna.storages.get_storage(self.storage)

    def _study_name(self, storage: BaseStorage) -> str:
        """The folder may have been renamed since its study was named after it."""
        names = optuna.get_all_study_names(storage)
        if self.storage is None and names:
            return names[0]  # a journal holds one
        noted = ""
        with contextlib.suppress(ValueError, OSError):
            noted = json.loads((self.folder / "sweep.json").read_text()).get("study", "")
        return noted if noted in names else f"{self.name}-{self.folder.name}"

    def start(
        self, trials: int, ended: Callable[[optuna.Study, FrozenTrial], None] | None = None
    ) -> optuna.Study:
        """Run trials until so many are finished, those of earlier calls included.

        A trial that was stopped, or whose process died, is continued first.
        """
        study = self.study()
        self._take_up(study)
        while sum(t.state in _FINISHED for t in study.get_trials(deepcopy=False)) < trials:
            study.optimize(self._trial, n_trials=1, callbacks=[ended] if ended else None)
        return study

    def _take_up(self, study: optuna.Study) -> None:
        """Queue the trials that were stopped, in their folders."""
        latest: dict[str, FrozenTrial] = {}
        for trial in study.get_trials(deepcopy=False):
            for key in ("continues", "folder"):
                if key in trial.user_attrs:
                    latest[trial.user_attrs[key]] = trial
        for folder, trial in latest.items():
            status = ""
            with contextlib.suppress(ValueError):  # where it is on another machine
                status = read_run(self.folder / folder).status
            if trial.state not in (TrialState.RUNNING, TrialState.FAIL):
                continue
            if status in ("stopped", "interrupted"):
                if trial.state is TrialState.RUNNING:
                    study.tell(trial.number, state=TrialState.FAIL)
                study.enqueue_trial(trial.params, user_attrs={"continues": folder})

    def _trial(self, trial: optuna.Trial) -> float:
        # By the trial's number: neither a sweep that is continued nor another process on the same
        # storage draws the same values again.
        seeds = np.random.SeedSequence([self.config.seed, trial.number])
        seed = int(seeds.generate_state(1)[0])
        trial.study.sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=5)
        values = {key: _suggest(trial, key, space) for key, space in self.space.items()}
        before = trial.user_attrs.get("continues", "")
        out = str(self.folder / (before or f"trial_{trial.number:04d}"))
        try:
            config = dataclasses.replace(self.config, **values, out=out, resume=bool(before))
        except ValueError as error:  # this combination makes no sense
            trial.set_user_attr("refused", str(error))
            raise optuna.TrialPruned(str(error)) from None
        command = ["hmcts", "train", f"experiment={self.name}"]
        command += [f"{key}={value}" for key, value in {**values, "out": out}.items()]
        opened = open_run(config, experiment=self.name, command=command, fresh=not before)
        with opened as run:
            trial.set_user_attr("folder", run.path.name)
            with observed(lambda name, value, step: self._watch(trial, name, value, step)):
                return figure_of(self.run(run.config), self.objective)

    def _watch(self, trial: optuna.Trial, name: str, value: float, step: int) -> None:
        if name != self.progress:
            return
        trial.report(-value if self.objective.startswith("-") else value, step)
        if trial.should_prune():
            raise Pruned(f"{name}={value:.4g} at {step} is below the others' median.")

    def _description(self) -> dict[str, Any]:
        default = type(self.config)()
        varied = (*_NOT_FIXED, *self.space)
        return {
            "experiment": self.name,
            "objective": self.objective,
            _SPACE: {key: repr(space) for key, space in self.space.items()},
            "fixed": {
                key: value
                for key, value in dataclasses.asdict(self.config).items()
                if key not in varied and value != getattr(default, key)
            },
        }


def _suggest(trial: optuna.Trial, key: str, space: BaseDistribution) -> Any:
    if isinstance(space, CategoricalDistribution):
        return trial.suggest_categorical(key, space.choices)
    if isinstance(space, Int):
        return trial.suggest_int(key, space.low, space.high, step=space.step, log=space.log)
    assert isinstance(space, Float)
    return trial.suggest_float(key, space.low, space.high, step=space.step, log=space.log)


def figure_of(metrics: Mapping[str, Any], objective: str) -> float:
    """Return a figure of a run by name; not a number counts as the worst there is."""
    numbers = {
        name: float(value)
        for name, value in flat(metrics)
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
    value = numbers.get(objective.removeprefix("-"))
    if value is None:
        raise ValueError(
            f"The run has no figure {objective!r}. It has: {', '.join(sorted(numbers))}."
        )
    worst = math.inf if objective.startswith("-") else -math.inf
    return value if math.isfinite(value) else worst


def trial_rows(study: optuna.Study) -> list[dict[str, Any]]:
    """Return the trials of a study as plain values, the best first."""
    sign = -1.0 if study.direction == optuna.study.StudyDirection.MAXIMIZE else 1.0
    states = {TrialState.PRUNED: "given up", TrialState.RUNNING: "running or interrupted"}
    rows = []
    for trial in study.get_trials(deepcopy=False):
        done = trial.state is TrialState.COMPLETE and math.isfinite(trial.value or 0.0)
        duration = trial.duration
        rows.append(
            {
                "trial": trial.number,
                "state": states.get(trial.state, trial.state.name.lower()),
                "value": trial.value if done else None,  # one that was not finite came as the worst
                "params": dict(trial.params),
                "folder": trial.user_attrs.get("folder", ""),
                "seconds": None if duration is None else round(duration.total_seconds(), 1),
                "refused": trial.user_attrs.get("refused", ""),
            }
        )
    return sorted(rows, key=lambda row: (row["value"] is None, sign * (row["value"] or 0.0)))


def importances(study: optuna.Study) -> dict[str, float]:
    """Return how much of what sets the best trials apart lies in each key; they sum to 1.

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
