"""Running an experiment: what is written before and after, and what users see of a mishap."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from torchrl_hmcts.trainers.command_line.words import set_log_level
from torchrl_hmcts.trainers.experiments.registry import Experiment, ExperimentError
from torchrl_hmcts.trainers.experiments.run_folder import end_record, start_record


def run_experiment(
    name: str, experiment: Experiment, config: Any, words: Sequence[str], log_level: str = "info"
) -> int:
    """Run an experiment, with ``run.json`` in its folder; return the exit status.

    Args:
        name: the command as users type it, e.g. ``"train experiment=labmaze"``.
        experiment: what to run.
        config: its configuration.
        words: the whole command line, for the record.
        log_level: how much is said.
    """
    try:
        with said(log_level):
            _ = experiment.function
            from torchrl_hmcts.trainers.figures.report import machine, versions

            facts = {"versions": versions(), "machine": machine()}
            start_record(experiment.name, config, words, facts)
            with recorded(config.out):
                experiment(config)
    except ModuleNotFoundError as error:
        return missing(error)
    except RuntimeError as error:
        if type(error).__name__ == "CollectorError":
            return fail(name, f"{error} Or {_going_on(name, config)}")
        if type(error).__name__ != "CheckpointError":  # torchrl's; not worth its import here
            raise
        return fail(name, error)
    except FileNotFoundError as error:
        if error.errno is None:  # there is no checkpoint to go on from
            return fail(name, error)
        return fail(name, f"{error}. Choose another folder with out=DIR.")
    except OSError as error:  # e.g. a folder that cannot be written
        return fail(name, f"{error}. Choose another folder with out=DIR.")
    except (ExperimentError, FloatingPointError, ImportError) as error:
        return fail(name, error)
    except KeyboardInterrupt:
        print(f"\nhmcts {name}: stopped; {_going_on(name, config)}", file=sys.stderr)
        return 130
    return 0


@contextlib.contextmanager
def recorded(out: str) -> Iterator[None]:
    """Note in the folder's ``run.json`` how what is done in the context ends."""
    try:
        yield
    except KeyboardInterrupt:
        end_record(out, "stopped")
        raise
    except BaseException:
        end_record(out, "failed")
        raise
    end_record(out, "finished")


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


def _going_on(name: str, config: Any) -> str:
    if hasattr(config, "resume"):
        return f"go on with: hmcts {name} out={config.out} resume=true"
    return "it starts anew, run it again."
