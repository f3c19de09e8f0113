"""Words of the command line: keys of the command itself, of an experiment, and of its parts."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields, replace
from difflib import get_close_matches
from itertools import product
from typing import Any

from torchrl_hmcts.trainers.experiments.registry import EXPERIMENTS, KITS, Experiment
from torchrl_hmcts.trainers.runs.config import home, key_kinds, parse_overrides, unknown_key

LOG_LEVELS = ("debug", "info", "warning", "error")
LOG_LEVEL_HELP = (
    "log_level=debug|info|warning|error: how much is printed (default info; with warning\n"
    "  and error no progress is shown either)."
)


def parse_config(
    experiment: Experiment, words: Sequence[str], base: Any = None, others: Sequence[str] = ()
) -> Any:
    """Return the configuration of an experiment; its parts are composed with Hydra.

    It is :func:`with_parts` of :func:`parse_keys`.
    """
    return with_parts(*parse_keys(experiment, words, base, others))


def parse_keys(
    experiment: Experiment, words: Sequence[str], base: Any = None, others: Sequence[str] = ()
) -> tuple[Any, list[str]]:
    """Return the configuration without its parts, and the words for these; load no torch."""
    kinds = key_kinds(experiment.config_class)
    names = {name for name, kind in kinds.items() if kind == "dict"}
    chosen = [w for w in words if w.partition("=")[0].replace("/", ".").split(".")[0] in names]
    rest = [word for word in words if word not in chosen]
    config = parse_overrides(experiment.config_class, rest, base=base, others=others)
    made = [word for word in chosen if word.startswith("make.")]
    if made:
        from omegaconf import OmegaConf

        keywords: Any = OmegaConf.to_container(OmegaConf.from_dotlist(made))
        config = replace(config, make={**config.make, **keywords["make"]})
        chosen = [word for word in chosen if word not in made]
    return config, chosen


def with_parts(config: Any, chosen: Sequence[str]) -> Any:
    """Return a configuration whose parts are changed by words."""
    if not chosen:
        return config
    first = [word for word in chosen if word.startswith("objective")]
    if 0 < len(first) < len(chosen):  # the default of the loss depends on it
        config = with_parts(config, first)
        chosen = [word for word in chosen if word not in first]
    from torch.random import fork_rng

    from torchrl_hmcts.planners import MCTSPlanner, SearchSettings
    from torchrl_hmcts.testing import ChainEnv
    from torchrl_hmcts.trainers.configs import COMPONENTS, compose_parts, full
    from torchrl_hmcts.trainers.experiments.kits import make_kit
    from torchrl_hmcts.trainers.parts import build, differences, merged

    own = make_kit(config).parts()
    now = {part: merged(node, getattr(config, part)) for part, node in own.items()}
    composed = compose_parts(now, chosen)
    planner = composed["planner"]  # what is wrong with it is said before all work
    for name, part in planner.items():
        if isinstance(part, dict) and "_component_" in part:
            build(**part)
        elif name in COMPONENTS and part is not None:
            raise ValueError(
                f"planner.{name} is a part; got {part!r}. Write planner/{name}=NAME "
                f"({', '.join(COMPONENTS[name])}), or planner.{name}.KEY=VALUE for its keywords."
            )
    names = {field.name for field in fields(SearchSettings)}
    settings = {k: value for k, value in planner.items() if k in names and value is not None}
    build("torchrl_hmcts.planners.SearchSettings", **settings)
    MCTSPlanner(ChainEnv(length=2), gamma=planner.get("gamma"), seed=planner.get("seed"))
    config = replace(
        config, **{part: differences(full(own[part]), node) for part, node in composed.items()}
    )
    if config.loss:
        from torchrl_hmcts.trainers.experiments.skills import make_loss

        with fork_rng(devices=[]):
            make_loss(make_kit(config))  # the same for the loss
    return config


def expand(words: Sequence[str]) -> list[list[str]]:
    """Return the words of each run of ``-m``: all combinations of values with commas."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    values = []
    for word in words:
        (override,) = OverridesParser.create().parse_overrides([word])
        key = word.partition("=")[0]
        swept = override.sweep_string_iterator() if override.is_sweep_override() else None
        values.append([word] if swept is None else [f"{key}={value}" for value in swept])
    return [list(combination) for combination in product(*values)]


def split_words(words: Sequence[str], own: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take the keys of the command out of its words."""
    found: dict[str, str] = {}
    rest = []
    for word in words:
        key, separator, value = word.partition("=")
        if not separator or key not in (*own, "log_level"):
            rest.append(word)
            continue
        if key in found:
            raise ValueError(f"{key} is given twice: {key}={found[key]} and {word}.")
        if not value:
            raise ValueError(f"{key}= has no value.")
        found[key] = value
    level = found.get("log_level", "info")
    if level not in LOG_LEVELS:
        raise ValueError(f"log_level is one of {', '.join(LOG_LEVELS)}; got {level!r}.")
    return found, rest


def only_words(words: Sequence[str], own: Sequence[str]) -> dict[str, str]:
    """Read the words of a command that has no keys but its own."""
    found, rest = split_words(words, own)
    no_bare_words(rest, own[0])
    if rest:
        raise ValueError(unknown_key(rest[0].partition("=")[0], [*own, "log_level"]))
    return found


def no_bare_words(words: Sequence[str], folder: str = "") -> None:
    """Refuse a word that lacks its key, and say with which key to write it."""
    for word in words:
        if "=" in word:
            continue
        keys = {"experiment": word in EXPERIMENTS, "kit": word in KITS}
        keys |= {folder: os.path.isdir(home(word))} if folder else {}
        for key, fits in keys.items():
            if fits:
                raise ValueError(f"{word!r} is no key=value. Write {key}={word}.")
        near = get_close_matches(word, [*EXPERIMENTS, *KITS], n=1, cutoff=0.7)
        if near:
            key = "experiment" if near[0] in EXPERIMENTS else "kit"
            raise ValueError(f"{word!r} is no key=value. Did you mean {key}={near[0]}?")
