"""Running an experiment: what is written before and after, and what users see of a mishap."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.command_line.words import set_log_level
from torchrl_hmcts.trainers.experiments.registry import Experiment
from torchrl_hmcts.trainers.runs.config import ExperimentError
from torchrl_hmcts.trainers.runs.run import open_run, resume_command
from torchrl_hmcts.trainers.saving.locking import FolderInUse
from torchrl_hmcts.trainers.saving.stopping import Stopped, signals_handled


def run_experiment(
    name: str,
    experiment: Experiment,
    config: Any,
    words: Sequence[str],
    log_level: str = "info",
    *,
    fresh: bool = False,
) -> int:
    """Run an experiment, with ``run.json`` in its folder; return the exit status.

    Args:
        name: the command as users type it, e.g. ``"train experiment=labmaze"``.
        experiment: what to run.
        config: its configuration.
        words: the whole command line, for the record.
        log_level: how much is said.
        fresh: no folder was named: take the first of ``out``, ``out_2``, ... that holds nothing.
    """
    resume = ""  # how to continue, once there is a run
    try:
        with said(log_level), signals_handled():
            _ = experiment.function
            with open_run(config, experiment=experiment.name, command=words, fresh=fresh) as run:
                resume = run.resume_command
                if run.config.out != config.out:
                    print(f"{config.out} holds a run already; this one goes to {run.config.out}.")
                config = run.config
                if getattr(config, "resume", False) and not run.resumes:
                    print("The run was stopped before its first checkpoint: it begins again.")
                experiment(config)
    except ModuleNotFoundError as error:
        return missing(error)
    except FolderInUse as error:
        return fail(name, error)
    except RuntimeError as error:
        if type(error).__name__ == "CollectorError":
            return fail(name, f"{error} Or continue with: {resume or resume_command(config.out)}")
        if type(error).__name__ != "CheckpointError":  # torchrl's; not worth its import here
            raise
        return fail(name, error)
    except FileNotFoundError as error:
        if error.errno is None:  # there is no checkpoint to go on from
            return fail(name, error)
        return fail(name, _with_advice(error, resume))
    except OSError as error:  # e.g. a folder that cannot be written
        return fail(name, _with_advice(error, resume))
    except (ExperimentError, FloatingPointError, ImportError) as error:
        return fail(name, error)
    except KeyboardInterrupt as error:
        how = f"{_saved(config.out)} Continue with: {resume}" if resume else "nothing was begun."
        print(f"\nhmcts {name}: stopped. {how}", file=sys.stderr)
        return error.status if isinstance(error, Stopped) else 130
    return 0


def _saved(out: str) -> str:
    """A sentence on what a run that was stopped has saved."""
    names = [p.name for p in Path(out, "checkpoints").glob("[!.]*") if p.suffix != ".json"]
    if not names:
        return "It had written no checkpoint yet and will begin again."
    return f"Saved: {Path(out, 'checkpoints', max(names))}."


@contextlib.contextmanager
def said(log_level: str) -> Iterator[None]:
    """Say as much as the level allows while in the context; warnings and errors always come."""
    if set_log_level(log_level):
        yield
        return
    os.environ["TQDM_DISABLE"] = "1"
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        os.environ.pop("TQDM_DISABLE", None)


def refuse(command: str, message: object) -> int:
    """Say what was wrong with the words of a command; return the exit status for it."""
    print(f"hmcts {command}: {message}", file=sys.stderr)
    return 2


def fail(command: str, message: object) -> int:
    """Say what went wrong; return the exit status for it."""
    print(f"hmcts {command}: {message}", file=sys.stderr)
    return 1


def missing(error: ModuleNotFoundError) -> int:
    """Say which package is not installed and which extra has it."""
    name = (error.name or "a package").partition(".")[0]
    extra = {"ray": "scale", "optuna": "scale", "ale_py": "atari", "wandb": "wandb"}
    print(
        f"hmcts needs {name}, which is not installed. Install the extra that has it: "
        f"pip install 'torchrl_hmcts[{extra.get(name, 'train')}]'",
        file=sys.stderr,
    )
    return 1


def _with_advice(error: OSError, resume: str = "") -> str:
    """Another folder helps where a file could not be written, not where the system lacks more."""
    text = str(error).rstrip(".")
    if any(word in text for word in ("/dev/shm", "ulimit", "TMPDIR")):
        return f"{text}."
    how = f"Continue with: {resume}, or choose" if resume else "Choose"
    return f"{text}. {how} another folder with out=DIR."
