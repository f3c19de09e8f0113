"""``hmcts demo``, ``hmcts train``."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from torchrl_hmcts.trainers.command_line.running import missing, refuse, run_experiment
from torchrl_hmcts.trainers.command_line.words import LOG_LEVELS, set_log_level, split_words
from torchrl_hmcts.trainers.config import parse_overrides
from torchrl_hmcts.trainers.experiments.registry import (
    DEMO,
    EXPERIMENTS,
    Experiment,
    find_experiment,
)
from torchrl_hmcts.trainers.experiments.run_folder import load_config, read_run


def demo(words: Sequence[str]) -> int:
    """Run ``hmcts demo key=value ...``; return the exit status."""
    return _new("demo", DEMO, words, ["hmcts", "demo", *words])


def train(words: Sequence[str]) -> int:
    """Run ``hmcts train experiment=NAME key=value ...`` or ``hmcts train resume=DIR``."""
    line = ["hmcts", "train", *words]
    try:
        own, rest = split_words(words, ["experiment"])
        resumed = [word.partition("=")[2] for word in rest if _names_folder(word)]
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
    except ModuleNotFoundError as error:
        return missing(error)
    except ValueError as error:
        return refuse(name, error)
    return run_experiment(name, experiment, config, line, level)


def _go_on(folder: str, words: Sequence[str], level: str, line: Sequence[str]) -> int:
    others = [word for word in words if not _names_folder(word)]
    if others:
        raise ValueError(
            f"resume={folder} goes on exactly as the run was begun; {others[0]!r} would change it. "
            f"To change keys on the way: experiment=NAME out={folder} resume=true and the keys."
        )
    experiment, config = load_config(read_run(folder))
    if not hasattr(config, "resume"):
        raise ValueError(f"{experiment.name} writes no checkpoints to go on from; run it again.")
    config = dataclasses.replace(config, resume=True)
    return run_experiment(f"train experiment={experiment.name}", experiment, config, line, level)


def _names_folder(word: str) -> bool:
    """Whether a word is ``resume=DIR`` rather than ``resume=true``."""
    key, _, value = word.partition("=")
    words_for_bools = ("true", "false", "yes", "no", "on", "off", "1", "0", "")
    return key == "resume" and value.lower() not in words_for_bools
