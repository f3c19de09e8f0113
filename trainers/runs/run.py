"""A run and its folder: taken before anything is written, locked, recorded, never overwritten.

Every command that writes a run opens it here: :func:`open_run`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.runs.config import BOOL_WORDS, ExperimentError, config_keys
from torchrl_hmcts.trainers.saving.files import left_out, remove, write_csv, write_json
from torchrl_hmcts.trainers.saving.locking import FolderInUse, folder_locked
from torchrl_hmcts.trainers.saving.run_folder import (
    RunFolder,
    end_record,
    read_run,
    start_record,
    versions,
)
from torchrl_hmcts.trainers.saving.stopping import Stopped, signals_handled, stop_asked

_RECORDS = (
    *("run.json", "metrics.json", "evaluation.json", "page.json", "curves.csv", "index.html"),
    "manager.torchrl",
)
_FOLDERS = ("checkpoints", "worker", "log", "play", "tensorboard", "wandb")
_PICTURES = (
    *("episode.gif", "episode.mp4", "goals.png", "learning.png", "losses.png", "mazes.png"),
    *("scores.png", "search.png", "skills.png", "solving.png", "view.png"),
)
_SWEEP = ("sweep.json", "journal.log", "importances.png", "trials.png")
_IN_FOLDERS = (  # other files there stay
    *("checkpoints/checkpoint-*", "checkpoints/run.pt*", "checkpoints/trials.json"),
    *("checkpoints/.*writing-*", "checkpoints/.lock", "worker/worker-*", "worker/.*writing-*"),
    *("play/index.html", "play/play.*", "play/search.png", "log", "tensorboard"),
)


class FolderRefused(ExperimentError):
    """A folder holds what a run would replace; the message says what, and what to type."""


@dataclass
class Run:
    """A run that has its folder to itself."""

    config: Any
    experiment: str
    resumes: bool = False

    @property
    def path(self) -> Path:
        """The folder."""
        return Path(self.config.out)

    @property
    def checkpoints(self) -> Path:
        """The folder of its checkpoints."""
        return self.path / "checkpoints"

    @property
    def resume_command(self) -> str:
        """The command that continues the run exactly."""
        return resume_command(self.config.out)

    def write_curves(
        self, curves: Mapping[str, tuple[Sequence[float], Sequence[float]]], steps: str
    ) -> None:
        """Write ``curves.csv``, a value a row: name, step, value."""
        rows = [
            (name, int(step), value)
            for name, (x, y) in curves.items()
            for step, value in zip(x, y, strict=True)
        ]
        with left_out("curves.csv"):
            write_csv(self.path / "curves.csv", ("name", steps, "value"), rows)

    @contextlib.contextmanager
    def finish(
        self, metrics: dict[str, Any], config: Any = None, *, title: str
    ) -> Iterator[Pictures]:
        """Write ``metrics.json``, note that the run is finished, then pictures and the page.

        What cannot be drawn or written is left out, with a line on stderr; figures that cannot be
        written, e.g. to a full disk, are printed. ``config`` is what was run, if not that of the
        run.
        """
        metrics.setdefault("config", dataclasses.asdict(self.config if config is None else config))
        metrics.setdefault("versions", versions())
        with left_out("metrics.json") as missing:
            write_json(self.path / "metrics.json", metrics)
        if missing:
            print(json.dumps(metrics, indent=1, default=str))
        pictures = Pictures(self.path)
        with left_out("what was still to be drawn"):
            end_record(self.path, "finished")
            yield pictures
        with left_out("index.html"):
            from torchrl_hmcts.trainers.figures.run_page import write_page

            file, keys = self.path / "index.html", config_keys(type(self.config))
            write_page(file, title=title, metrics=metrics, pictures=pictures.captions, keys=keys)
            print(f"Pictures and figures: {file}")


_current: ContextVar[Run | None] = ContextVar("run", default=None)


@contextlib.contextmanager
def open_run(
    config: Any, *, experiment: str = "", command: Sequence[str] = (), fresh: bool = False
) -> Iterator[Run]:
    """Take a folder for a run, and note in its ``run.json`` how what is done there ends.

    All that can be refused is refused before anything is written: packages and inputs that are
    missing, a folder in use, one that holds a run (unless ``config`` says ``resume`` or
    ``overwrite``), a run with other settings to resume. A run that is open already, with this very
    configuration, stays the same run: the command line opens it for the function of an experiment.
    """
    outer = _current.get()
    if outer is not None and outer.config is config:
        yield outer
        return
    config.check_inputs()
    name = experiment or config.EXPERIMENT
    with contextlib.ExitStack() as stack:
        config = _take(stack, config, name, fresh)
        run = Run(config, name, config.resume and _has_checkpoint(config.out))
        if config.overwrite:
            _clear(run.path)
        start_record(name, config, command)
        token = _current.set(run)
        stack.callback(_current.reset, token)
        stack.enter_context(signals_handled())
        stack.enter_context(_recorded(run.path))
        yield run


@contextlib.contextmanager
def _recorded(path: Path) -> Iterator[None]:
    """Note in ``run.json`` how what is done in the context ends."""
    try:
        yield
    except KeyboardInterrupt:
        end_record(path, "stopped")
        raise
    except BaseException as error:
        if stop_asked() and isinstance(error, Exception):  # the signal hit its processes as well
            end_record(path, "stopped")
            raise Stopped from error
        end_record(path, getattr(error, "run_status", "failed"))
        raise
    end_record(path, "finished")


def _take(stack: contextlib.ExitStack, config: Any, experiment: str, fresh: bool) -> Any:
    """Lock the folder of a configuration, or with ``fresh`` the first free one; return it."""
    for out in _names(config.out) if fresh else [config.out]:
        chosen = dataclasses.replace(config, out=out) if fresh else config
        try:
            with contextlib.ExitStack() as locked:
                check_folder(chosen, experiment)
                # `resume` has one: a folder that it would make is refused above.
                Path(out).mkdir(parents=True, exist_ok=True)
                locked.enter_context(folder_locked(out))
                check_folder(chosen, experiment)  # another may have written there meanwhile
                stack.push(locked.pop_all())
            return chosen
        except (FolderRefused, FolderInUse):
            if not fresh:
                raise
    raise AssertionError("names never end")


def free_folder(config: Any, experiment: str) -> str:
    """Return the first of ``out``, ``out_2``, ... in which a run loses nothing."""
    for out in _names(config.out):
        with contextlib.suppress(FolderRefused):
            check_folder(dataclasses.replace(config, out=out), experiment)
            return out
    raise AssertionError("names never end")


def _names(base: str) -> Iterator[str]:
    yield base
    yield from (f"{base.rstrip('/')}_{number}" for number in count(2))


def next_free(out: str) -> str:
    """Return the first of ``out``, ``out_2``, ``out_3``, ... that does not exist or is empty."""
    paths = map(Path, _names(out))
    return str(next(p for p in paths if not (p.is_file() or (p.is_dir() and any(p.iterdir())))))


def check_folder(config: Any, experiment: str) -> None:
    """Refuse a folder in which a run of this configuration would lose or mix up something."""
    path = Path(config.out)
    if path.exists() and not path.is_dir():
        raise FolderRefused(
            f"out={path} is a file. Name a folder, e.g. {_word('out', next_free(config.out))}."
        )
    if config.resume and config.overwrite:
        raise FolderRefused("resume=true continues a run, overwrite=true replaces it: choose one.")
    if config.resume:
        _check_resumable(config, experiment)
        return
    there = run_files(path)
    if not there:
        return
    other = next_free(config.out)
    run = None
    with contextlib.suppress(ValueError):
        run = read_run(path)
        if not (run.experiment or run.metrics):  # nothing in it can be read
            run = None
    if config.overwrite and run is not None:
        return
    if run is None:
        what = "a sweep" if set(there) & set(_SWEEP) else "files of the names that a run writes"
        raise FolderRefused(
            f"{path} holds {what} ({_some(there)}), which would be lost. Choose another folder, "
            f"e.g. {_word('out', other)}."
        )
    seed = "" if run.seed is None else f", seed {run.seed}"
    status = f"{run.status or ('finished' if run.metrics else 'unfinished')} run"
    status = f"{'an' if status[0] in 'aeiou' else 'a'} {status}"
    raise FolderRefused(
        f"{path} holds {status}{f' of {run.experiment}' if run.experiment else ''}{seed} "
        f"({_some(there)}). Continue it with: {resume_command(config.out)}; replace it with "
        f"overwrite=true; or choose another folder, e.g. {_word('out', other)}."
    )


def _check_resumable(config: Any, experiment: str) -> None:
    """Refuse a folder without a run to continue, or with one of other settings."""
    path = Path(config.out)
    try:
        run = read_run(path)
    except ValueError:
        if _has_checkpoint(path):  # written from Python, by an older version
            return
        raise FolderRefused(
            f"There is no checkpoint in {str(path)!r}, and no run to continue. Leave resume out to "
            "begin one there, or name the folder of the run."
        ) from None
    if not _has_checkpoint(path) and run.metrics:
        raise FolderRefused(
            f"There is no checkpoint in {str(path / 'checkpoints')!r}, but the figures of a run "
            "that has finished. Replace it with overwrite=true, or choose another folder, e.g. "
            f"{_word('out', next_free(config.out))}."
        )
    if experiment and run.experiment not in ("", experiment):
        raise FolderRefused(f"{path} holds a run of {run.experiment}, not of {experiment}.")
    changed = [
        f"{key} was {run.config[key]!r} and is {getattr(config, key)!r} here"
        for key in config.KEPT
        if key in run.config and run.config[key] != getattr(config, key)
    ]
    if changed:
        raise FolderRefused(
            f"{path} holds a run with other settings: {'; '.join(changed)}. Continue it as it was "
            f"with: {resume_command(config.out)}; or choose another folder for the new settings, "
            f"e.g. {_word('out', next_free(config.out))}."
        )


def run_files(path: Path) -> list[str]:
    """Return the names in a folder that a run or a sweep would write."""
    if not path.is_dir():
        return []
    names = sorted(entry.name for entry in path.iterdir())
    ours = {*_RECORDS, *_FOLDERS, *_PICTURES, *_SWEEP}
    return [name for name in names if name in ours or name.startswith("trial_")]


def _has_checkpoint(path: str | Path) -> bool:
    """Whether a run's folder has a checkpoint, whole or not."""
    folder = Path(path) / "checkpoints"
    return any(folder.glob("checkpoint-*")) or (folder / "run.pt").is_file()


def _clear(path: Path) -> None:
    """Remove what a run wrote into its folder, and nothing else."""
    run = RunFolder(path)
    with contextlib.suppress(ValueError):
        run = read_run(path)
    pictures = {name for name in run.pictures if Path(name).name == name}
    videos = {str(Path(name).with_suffix(".mp4")) for name in pictures if name.endswith(".gif")}
    for name in {*_RECORDS, *_PICTURES, *pictures, *videos}:
        remove(path / name)
    for entry in [entry for pattern in _IN_FOLDERS for entry in path.glob(pattern)]:
        remove(entry)


def resume_command(out: str | Path) -> str:
    """Return the command that continues a run exactly, as it can be pasted into a shell."""
    folder = str(out)
    return shlex.join(["hmcts", "train", f"resume={'./' * (folder.lower() in BOOL_WORDS)}{folder}"])


def _word(key: str, value: str) -> str:
    return shlex.quote(f"{key}={value}")


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
