"""Running an experiment: what is written before and after, and what users see of a mishap."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.command_line.words import with_parts
from torchrl_hmcts.trainers.experiments.registry import Experiment
from torchrl_hmcts.trainers.runs.config import ExperimentError
from torchrl_hmcts.trainers.runs.run import check_folder, free_folder, open_run
from torchrl_hmcts.trainers.saving.locking import FolderInUse
from torchrl_hmcts.trainers.saving.stopping import Stopped, signals_handled

WRONG_WORDS = (ValueError, TypeError, KeyError)
_EXTRAS = {"ray": "scale", "optuna": "scale", "ale_py": "atari", "wandb": "wandb"}


class Failure(Exception):
    """A command has failed; the message is all that its user sees."""

    def __init__(self, message: str, status: int = 1) -> None:
        super().__init__(message)
        self.status = status


@contextlib.contextmanager
def told(command: str, *wrong: type[Exception], resume: Sequence[str] = ()) -> Iterator[None]:
    """Turn errors that a user can do something about into a :class:`Failure`."""
    try:
        yield
    except ModuleNotFoundError as error:
        name = (error.name or "a package").partition(".")[0]
        raise Failure(
            f"hmcts needs {name}, which is not installed. Install the extra that has it: "
            f"pip install 'torchrl_hmcts[{_EXTRAS.get(name, 'train')}]'"
        ) from error
    except (FolderInUse, ExperimentError, FloatingPointError, ImportError) as error:
        raise Failure(f"hmcts {command}: {error}") from error
    except wrong as error:
        raise Failure(f"hmcts {command}: {error}", 2) from error
    except RuntimeError as error:  # by name: torchrl's; not worth its import here
        message = str(error)
        if type(error).__name__ == "CollectorError" and resume:
            message += f" Or continue with: {resume[0]}"
        elif type(error).__name__ not in ("CheckpointError", "CollectorError"):
            raise
        raise Failure(f"hmcts {command}: {message}") from error
    except OSError as error:  # e.g. a folder that cannot be written
        message = str(error)
        if not isinstance(error, FileNotFoundError) or error.errno is not None:
            message = with_advice(message, *resume)
        raise Failure(f"hmcts {command}: {message}") from error


def with_advice(text: str, resume: str = "") -> str:
    """Return what an OSError says, and another folder where that helps."""
    text = text.rstrip(".")
    if any(word in text for word in ("/dev/shm", "ulimit", "TMPDIR")):
        return f"{text}."
    how = f"Continue with: {resume}, or choose" if resume else "Choose"
    return f"{text}. {how} another folder with out=DIR."


def run_experiment(
    name: str,
    experiment: Experiment,
    config: Any,
    words: Sequence[str],
    log_level: str = "info",
    *,
    fresh: bool = False,
    parts: Sequence[str] = (),
) -> int:
    """Run an experiment, with ``run.json`` in its folder; return the exit status."""
    resume: list[str] = []  # how to continue, once there is a run
    try:
        with told(name, resume=resume), printing(log_level), signals_handled():
            announced = free_folder(config, experiment.name) if fresh else config.out
            if not (fresh or config.resume):  # before it is said that the run starts
                check_folder(config, experiment.name)
            if announced != config.out:
                print(f"{config.out} holds a run already; this one goes to {announced}.")
            from torchrl_hmcts.trainers.runs.console import alive

            print(_announcement(name, config, announced), flush=True)
            with told(name, *WRONG_WORDS):
                config = with_parts(config, parts)
            _ = experiment.function  # loads torch
            with open_run(config, experiment=experiment.name, command=words, fresh=fresh) as run:
                resume.append(run.resume_command)
                if run.config.out != announced:  # another run has just taken that folder
                    print(f"{announced} holds a run already; this one goes to {run.config.out}.")
                config = run.config
                if config.resume and not run.resumes:
                    print("The run was stopped before its first checkpoint: it begins again.")
                with alive():
                    experiment(config)
    except KeyboardInterrupt as error:
        how = f"{_saved(config.out)} Continue with: {resume[0]}" if resume else "nothing was begun."
        print(f"\nhmcts {name}: stopped. {how}", file=sys.stderr)
        return error.status if isinstance(error, Stopped) else 130
    return 0


def _announcement(name: str, config: Any, out: str) -> str:
    """Say what starts, where its files go, and how to watch it, before torch is loaded."""
    logger = getattr(config, "logger", "csv")
    watch = f"hmcts report {shlex.quote(out)}   (the page so far, from another terminal)"
    if logger == "tensorboard":
        watch = f"tensorboard --logdir {shlex.quote(out)}"
    elif logger == "wandb" and os.environ.get("WANDB_MODE", "offline") != "online":
        watch = f"W&B is offline: afterwards wandb sync {shlex.quote(out)}/wandb/offline-run-*"
    elif logger == "wandb":
        watch = "the page that wandb names below"
    what = "continues" if config.resume else "starts"
    return f"hmcts {name} {what}, seed {config.seed}\n  output  {out}\n  watch   {watch}"


def _saved(out: str) -> str:
    """A sentence on what a run that was stopped has saved."""
    names = [p.name for p in Path(out, "checkpoints").glob("[!.]*") if p.suffix != ".json"]
    if not names:
        return "It had written no checkpoint yet and will begin again."
    return f"Saved: {Path(out, 'checkpoints', max(names))}."


@contextlib.contextmanager
def printing(log_level: str) -> Iterator[None]:
    """Print as much as the level allows in the context; warnings and errors always come."""
    # TorchRL's own messages (a collector that shuts down, ...) are for those who ask for them.
    os.environ.setdefault("RL_LOGGING_LEVEL", {"info": "WARNING"}.get(log_level, log_level.upper()))
    logging.getLogger("torchrl").setLevel(os.environ["RL_LOGGING_LEVEL"])
    logging.getLogger("torchrl_hmcts").setLevel(log_level.upper())
    if log_level in ("debug", "info"):
        yield
        return
    os.environ["TQDM_DISABLE"] = "1"
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        os.environ.pop("TQDM_DISABLE", None)
