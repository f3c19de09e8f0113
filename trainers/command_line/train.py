"""``hmcts demo``, ``hmcts train``."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from typing import Any

from torchrl_hmcts.trainers.command_line.running import (
    WRONG_WORDS,
    Failure,
    run_experiment,
    told,
)
from torchrl_hmcts.trainers.command_line.words import (
    expand,
    no_bare_words,
    parse_keys,
    split_words,
)
from torchrl_hmcts.trainers.experiments.registry import (
    DEMO,
    EXPERIMENTS,
    KITS,
    Experiment,
    find_experiment,
    load_config,
)
from torchrl_hmcts.trainers.runs.config import BOOL_WORDS, home
from torchrl_hmcts.trainers.runs.run import next_free
from torchrl_hmcts.trainers.saving.run_folder import read_run


def demo(words: Sequence[str]) -> int:
    """Run ``hmcts demo key=value ...``; return the exit status."""
    for word in filter(_names_folder, words):
        raise Failure(f"hmcts demo: a demo is continued with: hmcts train {shlex.quote(word)}", 2)
    return _new("demo", DEMO, words, ["hmcts", "demo", *words])


def train(words: Sequence[str]) -> int:
    """Run ``hmcts train experiment=NAME key=value ...`` or ``hmcts train resume=DIR``."""
    line = ["hmcts", "train", *words]
    with told("train", *WRONG_WORDS):
        own, rest = split_words(words, ["experiment", "kit"])
        many = "-m" in rest
        rest = [word for word in rest if word != "-m"]
        no_bare_words(rest, "resume")
        resumed = [word.partition("=")[2] for word in rest if _names_folder(word)]
        if len(resumed) > 1:
            raise ValueError(f"one run at a time; got resume={resumed[0]} and {resumed[1]}.")
        named = [f"{key}={own[key]}" for key in ("experiment", "kit") if key in own]
        if not named and resumed:
            name, experiment, config = _continued(resumed[0], rest)
            return run_experiment(name, experiment, config, line, own.get("log_level", "info"))
        if len(named) != 1:
            raise ValueError(
                f"say which experiment, e.g. experiment={next(iter(EXPERIMENTS))} (all: hmcts "
                f"list), or which kit ({', '.join(KITS)}), or which run to continue, resume=DIR."
            )
        if resumed:
            raise ValueError(
                f"resume={resumed[0]} continues with the experiment and keys of that folder; leave "
                f"{named[0]} out. To change keys on the way: out=DIR resume=true and the keys."
            )
        among = EXPERIMENTS if "experiment" in own else KITS
        experiment = find_experiment(named[0].partition("=")[2], among)
        rest = [word for word in words if word not in (*named, "-m")]
        runs = expand(rest) if many else [rest]
    name = f"train {named[0]}"
    if not many:
        return _new(name, experiment, rest, line)
    outs = [word.partition("=")[2] for word in rest if word.startswith("out=")]
    out = outs[0] if outs else next_free(f"runs/{experiment.name}_multirun")
    statuses = []
    for number, chosen in enumerate(runs):
        chosen = [*(w for w in chosen if not w.startswith("out=")), f"out={out}/{number}"]
        line = ["hmcts", "train", *named, *chosen]
        print(shlex.join(line), flush=True)
        statuses.append(_new(name, experiment, chosen, line))
        if statuses[-1] >= 128:  # stopped
            break
    return max(statuses)


def _new(name: str, experiment: Experiment, words: Sequence[str], line: Sequence[str]) -> int:
    with told(name, *WRONG_WORDS):
        own, rest = split_words(words, [])
        config, parts = parse_keys(experiment, rest, others=["log_level"])
        fresh = False
        if not any(word.removeprefix("env.").startswith("out=") for word in rest):
            fresh = not (config.overwrite or config.resume)
            if config.toy:
                config = dataclasses.replace(config, out=f"{config.out}_toy")
    level = own.get("log_level", "info")
    return run_experiment(name, experiment, config, line, level, fresh=fresh, parts=parts)


def _continued(folder: str, words: Sequence[str]) -> tuple[str, Experiment, Any]:
    """The command, the experiment and the configuration of a run that is continued."""
    others = [word for word in words if not _names_folder(word)]
    if others:
        raise ValueError(
            f"resume={folder} continues exactly as the run was begun; {others[0]!r} would change "
            f"it. To change keys, type: experiment=NAME out={folder} resume=true and the keys."
        )
    experiment, config = load_config(read_run(home(folder)))
    config = dataclasses.replace(config, resume=True, overwrite=False)
    name = "demo" if experiment is DEMO else f"train experiment={experiment.name}"
    return name, experiment, config


def _names_folder(word: str) -> bool:
    """Whether a word is ``resume=DIR`` rather than ``resume=true``."""
    key, _, value = word.partition("=")
    return key == "resume" and value.lower() not in (*BOOL_WORDS, "")
