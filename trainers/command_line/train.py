"""``hmcts demo``, ``hmcts train``."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from glob import escape, glob
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.command_line.running import missing, refuse, run_experiment
from torchrl_hmcts.trainers.command_line.words import LOG_LEVELS, set_log_level, split_words
from torchrl_hmcts.trainers.experiments.registry import (
    DEMO,
    EXPERIMENTS,
    Experiment,
    find_experiment,
    load_config,
)
from torchrl_hmcts.trainers.runs.config import BOOL_WORDS, home, parse_overrides
from torchrl_hmcts.trainers.runs.run import resume_command, run_files
from torchrl_hmcts.trainers.saving.run_folder import read_run


def demo(words: Sequence[str]) -> int:
    """Run ``hmcts demo key=value ...``; return the exit status."""
    resumed = [word for word in words if _names_folder(word)]
    if resumed:
        return refuse("demo", f"a demo is continued with: hmcts train {shlex.quote(resumed[0])}")
    return _new("demo", DEMO, words, ["hmcts", "demo", *words])


def train(words: Sequence[str]) -> int:
    """Run ``hmcts train experiment=NAME key=value ...`` or ``hmcts train resume=DIR``."""
    line = ["hmcts", "train", *words]
    try:
        own, rest = split_words(words, ["experiment"])
        resumed = [word.partition("=")[2] for word in rest if _names_folder(word)]
        if len(resumed) > 1:
            raise ValueError(f"one run at a time; got resume={resumed[0]} and {resumed[1]}.")
        if "experiment" not in own and resumed:
            return _go_on(resumed[0], rest, own.get("log_level", "info"), line)
        if "experiment" not in own:
            raise ValueError(
                f"say which experiment, e.g. experiment={next(iter(EXPERIMENTS))} "
                "(all: hmcts list), or which run to go on with, resume=DIR."
            )
        if resumed:
            raise ValueError(
                f"resume={resumed[0]} goes on with the experiment and keys of that folder; leave "
                f"experiment={own['experiment']} out. To change keys on the way: out=DIR "
                "resume=true and the keys."
            )
        experiment = find_experiment(own["experiment"])
    except ValueError as error:
        return refuse("train", error)
    words = [word for word in words if not word.startswith("experiment=")]
    return _new(f"train experiment={experiment.name}", experiment, words, line)


def _new(name: str, experiment: Experiment, words: Sequence[str], line: Sequence[str]) -> int:
    try:
        own, rest = split_words(words, [])
        level = own.get("log_level", "info")
        if level not in LOG_LEVELS:
            set_log_level(level)  # raises
        config = parse_overrides(experiment.config_class, rest, others=["log_level"])
        fresh = False
        if not any(word.removeprefix("env.").startswith("out=") for word in rest):
            config, fresh = _default_folder(config)
    except ModuleNotFoundError as error:
        return missing(error)
    except (ValueError, TypeError) as error:
        return refuse(name, error)
    return run_experiment(name, experiment, config, line, level, fresh=fresh)


def _default_folder(config: Any) -> tuple[Any, bool]:
    """The configuration with the default folder, and whether the next free one may be taken."""
    if config.toy:
        config = dataclasses.replace(config, out=f"{config.out}_toy")
    if config.overwrite:
        return config, False
    if not config.resume:
        return config, True
    there = [config.out, *sorted(glob(f"{escape(config.out)}_[0-9]*"))]
    there = [out for out in there if run_files(Path(out))]
    there = [out for out in there if _fits(out, config)] or there
    if len(there) > 1:
        raise ValueError(
            f"say which run to continue: {', '.join(resume_command(out) for out in there)}."
        )
    return dataclasses.replace(config, out=there[0]) if there else config, False


def _fits(out: str, config: Any) -> bool:
    """Whether a folder holds a run that these keys may continue, e.g. of the same game."""
    try:
        saved = read_run(out).config
    except ValueError:
        return False
    return all(saved.get(key) == getattr(config, key) for key in config.KEPT)


def _go_on(folder: str, words: Sequence[str], level: str, line: Sequence[str]) -> int:
    others = [word for word in words if not _names_folder(word)]
    if others:
        raise ValueError(
            f"resume={folder} goes on exactly as the run was begun; {others[0]!r} would change it. "
            f"To change keys on the way: experiment=NAME out={folder} resume=true and the keys."
        )
    experiment, config = load_config(read_run(home(folder)))
    config = dataclasses.replace(config, resume=True, overwrite=False)
    name = "demo" if experiment is DEMO else f"train experiment={experiment.name}"
    return run_experiment(name, experiment, config, line, level)


def _names_folder(word: str) -> bool:
    """Whether a word is ``resume=DIR`` rather than ``resume=true``."""
    key, _, value = word.partition("=")
    return key == "resume" and value.lower() not in (*BOOL_WORDS, "")
