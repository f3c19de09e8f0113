"""Configuration of the command line's experiments, as dataclasses."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

from torchrl_hmcts.arguments import name_arguments

C = TypeVar("C")

NUM_TEST_MAZES = 342
FRAMES_PER_BATCH = 64
LOGGERS = ("csv", "tensorboard", "wandb")


@name_arguments
@dataclass
class DemoConfig:
    """What ``hmcts demo`` does; every value can be given as ``key=value`` on the command line.

    Raises:
        ValueError: if a number is out of its range, ``train_base_steps`` is no multiple of 64 or
            the logger is unknown.

    Example:
        >>> DemoConfig(seed=3).train_base_steps
        40000
    """

    seed: int = 0
    """Seed of networks, training, and the starts and targets in the test mazes."""
    out: str = "runs/demo"
    """Folder that receives metrics, pictures and the page; made if absent."""
    mazes: int = 100
    """Test mazes to solve, at most the 342 of the test split."""
    num_skills: int = 4
    """Skills of the worker, the options of the manager (the source's N_policies)."""
    option_steps: int = 25
    """Base steps of an option (the source's N_worker_samples)."""
    skill_steps: int = 50
    """Base steps of a mini-episode in training: long enough for the skills to part."""
    train_base_steps: int = 40_000
    """Base steps of worker training in the training mazes."""
    leaves_per_wave: int = 4
    """Leaves of the tree whose options are simulated together; more are faster, less selective."""
    novelty_radius: float = 1.0
    """Tiles within which a place counts as visited; about what an option covers."""
    expansions: int = 1_000
    """Nodes that a search may expand before it gives up."""
    gamma: float = 0.99
    """Discount per base step."""
    logger: str = "csv"
    """Where values go while it trains: "csv" (always), "tensorboard" or "wandb" as well."""
    toy: bool = False
    """1,920 base steps of training and 3 mazes, to see in seconds that everything works."""

    def __post_init__(self) -> None:
        for name in (
            "mazes",
            "num_skills",
            "option_steps",
            "skill_steps",
            "train_base_steps",
            "expansions",
            "leaves_per_wave",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}.")
        if not self.novelty_radius > 0.0:
            raise ValueError(f"novelty_radius must be above 0 tiles; got {self.novelty_radius}.")
        if not 0.0 < self.gamma <= 1.0:
            raise ValueError(f"gamma must be in (0, 1]; got {self.gamma}.")
        if self.train_base_steps % FRAMES_PER_BATCH:
            raise ValueError(
                f"train_base_steps={self.train_base_steps} is no whole number of batches of "
                f"{FRAMES_PER_BATCH} base steps; use a multiple of {FRAMES_PER_BATCH}."
            )
        check_logger(self.logger)
        if self.mazes > NUM_TEST_MAZES:
            raise ValueError(f"mazes={self.mazes}, but the test split has {NUM_TEST_MAZES} mazes.")


def check_logger(name: str) -> None:
    """Check the name of a logger.

    Args:
        name: one of ``LOGGERS``.

    Raises:
        ValueError: if it is none of them.

    Example:
        >>> check_logger("csv")
    """
    if name not in LOGGERS:
        raise ValueError(f"logger is one of {', '.join(LOGGERS)}; got {name!r}.")


def parse_overrides(
    config_class: type[C],
    overrides: Sequence[str],
    *,
    base: C | None = None,
    others: Sequence[str] = (),
) -> C:
    """Build a configuration from ``key=value`` words, types checked.

    Keys of an experiment have one level; those who know Hydra may write ``env.game=Pong`` all the
    same.

    Args:
        config_class: a dataclass whose fields all have defaults.
        overrides: words of the command line.
        base: configuration whose values hold where no word says otherwise. Default: the defaults.
        others: keys of the same command that belong to no configuration, to be suggested as well.

    Returns:
        The configuration.

    Raises:
        ValueError: if a word is no ``key=value``, a key is unknown (the nearest ones are named) or
            a value has the wrong type.

    Example:
        >>> parse_overrides(DemoConfig, ["seed=1", "out=runs/one"]).out
        'runs/one'
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError  # values are read as YAML

    names = [field.name for field in fields(config_class)]  # type: ignore[arg-type]
    overrides = [word.removeprefix("env.") for word in overrides]
    for word in overrides:
        key, separator, _ = word.partition("=")
        if not separator:
            raise ValueError(f"{word!r} is no key=value, e.g. {names[0]}=1.")
        if key not in names:
            raise ValueError(unknown_key(key, [*names, *others]))
    try:
        merged = OmegaConf.merge(
            OmegaConf.structured(config_class if base is None else base),
            OmegaConf.from_dotlist(overrides),
        )
        return config_class(**{name: getattr(merged, name) for name in names})
    except YAMLError as error:
        raise ValueError(
            f"A value of {overrides} cannot be read: {str(error).splitlines()[0]}. Close "
            "its quotes and brackets."
        ) from None
    except OmegaConfBaseException as error:
        key = f"{error.full_key}: " if getattr(error, "full_key", None) else ""
        raise ValueError(key + str(error).splitlines()[0]) from None


def unknown_key(key: str, known: Sequence[str]) -> str:
    """Return the sentence that refuses a key and names the nearest ones.

    Args:
        key: what was typed.
        known: all keys.

    Example:
        >>> unknown_key("sede", ["seed", "out"])
        "Unknown key 'sede'. Did you mean: seed?"
    """
    near = difflib.get_close_matches(key, known, n=3, cutoff=0.4) or list(known)
    return f"Unknown key {key!r}. Did you mean: {', '.join(near)}?"
