"""Configuration of the command line's experiments, as dataclasses."""

from __future__ import annotations

import difflib
import importlib
import math
import numbers
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, TypeVar

from torchrl_hmcts.arguments import name_arguments

C = TypeVar("C")

NUM_TEST_MAZES = 342
FRAMES_PER_BATCH = 64
LOGGERS = ("csv", "tensorboard", "wandb")
MAX_SEED = 2**32 - 1
_TRUE, _FALSE = ("true", "yes", "on", "1"), ("false", "no", "off", "0")
BOOL_WORDS = (*_TRUE, *_FALSE)


@dataclass
class RunConfig:
    """Keys that every run has; the configurations of the experiments extend it.

    Whole numbers may be NumPy's, paths may be ``Path`` objects, and a ``~`` at the start of a path
    is the home folder, once and for all.

    Raises:
        TypeError: if a value is not of its field's type.
        ValueError: if ``seed`` is not between 0 and 2**32 - 1, a number is not finite, or ``out``
            is empty.

    Example:
        >>> RunConfig(seed=3).seed
        3
    """

    seed: int = 0
    """Seed of all random numbers, 0 to 4294967295."""
    out: str = "runs/run"
    """Folder of the run; made if absent. Default: the first of this name, name_2, name_3, ... that
    holds no run yet."""
    resume: bool = False
    """Continue the run in `out` from its newest checkpoint."""
    overwrite: bool = False
    """Replace the run that is in `out`; other files there stay."""
    toy: bool = False
    """A run of seconds, to see that everything works."""

    KEPT: ClassVar[tuple[str, ...]] = ("seed", "toy")  # a run that is resumed keeps these
    PATHS: ClassVar[tuple[str, ...]] = ("out",)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = _checked(field.name, str(field.type), getattr(self, field.name))
            if field.name in self.PATHS:
                value = home(value)
            setattr(self, field.name, value)
        if not self.out:
            raise ValueError("out is empty; name a folder, e.g. out=runs/mine.")
        if not 0 <= self.seed <= MAX_SEED:
            raise ValueError(f"seed must be 0 to {MAX_SEED}; got {self.seed}.")

    def check_inputs(self) -> None:
        """Check what the run needs from outside, before anything is written.

        Raises:
            ModuleNotFoundError: if the package of the logger is not installed.
        """
        logger = getattr(self, "logger", "csv")
        if logger != "csv":
            need_package(logger)


def _checked(name: str, kind: str, value: Any) -> Any:
    """A value of a field as the plain Python type that its annotation says."""
    if kind == "bool":
        if not isinstance(value, bool) and type(value).__name__ not in ("bool_", "bool"):
            raise TypeError(f"{name} is true or false; got {value!r}.")
        return bool(value)
    if kind == "int":
        if not isinstance(value, numbers.Integral) or isinstance(value, bool):
            raise TypeError(f"{name} must be a whole number; got {value!r}.")
        return int(value)
    if kind == "float":
        if not isinstance(value, numbers.Real) or isinstance(value, bool):
            raise TypeError(f"{name} must be a number; got {value!r}.")
        if not math.isfinite(value):
            raise ValueError(f"{name} must be a finite number; got {value!r}.")
        return float(value)
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if not isinstance(value, str):
        raise TypeError(f"{name} must be a text; got {value!r}.")
    if "\0" in value:
        raise ValueError(f"{name} must not hold a zero byte; got {value!r}.")
    return value


def home(path: str) -> str:
    """Return a path as it was typed, with a ``~`` at its start replaced by the home folder.

    Args:
        path: as typed by a user.

    Raises:
        ValueError: if the home folder is unknown.

    Example:
        >>> home("runs/~x"), home("~").startswith("~")
        ('runs/~x', False)
    """
    expanded = os.path.expanduser(path)
    if path.partition("/")[0] == "~" and expanded == path:
        raise ValueError(f"{path!r} begins with ~, but no home folder is known; type the path out.")
    return expanded


def need_package(name: str) -> None:
    """Import an optional package, so that its absence is noticed before a run begins.

    Args:
        name: of the package.

    Raises:
        ModuleNotFoundError: if it is not installed; a mere folder of this name does not count.

    Example:
        >>> need_package("json")
    """
    module = importlib.import_module(name)
    if getattr(module, "__file__", None) is None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)


@name_arguments
@dataclass
class DemoConfig(RunConfig):
    """What ``hmcts demo`` does; every value can be given as ``key=value`` on the command line.

    Raises:
        ValueError: if a number is out of its range, ``train_base_steps`` is no multiple of 64 or
            the logger is unknown.

    Example:
        >>> DemoConfig(seed=3).train_base_steps
        40000
    """

    out: str = "runs/demo"
    """Folder that receives metrics, pictures, checkpoints and the page; made if absent. Default:
    runs/demo (runs/demo_toy with toy=true), or the next of runs/demo_2, ... that holds no run."""
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

    KEPT = ("seed", "toy", "num_skills", "skill_steps")

    def __post_init__(self) -> None:
        super().__post_init__()
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
    types = {field.name: str(field.type) for field in fields(config_class)}  # type: ignore[arg-type]
    given: dict[str, Any] = {}
    for word in overrides:
        word = word.removeprefix("env.")
        key, separator, value = word.partition("=")
        if not separator:
            raise ValueError(f"{word!r} is no key=value, e.g. {next(iter(types))}=1.")
        if key not in types:
            raise ValueError(unknown_key(key, [*types, *others]))
        if key in given:
            raise ValueError(f"{key} is given twice.")
        given[key] = read_value(key, value, types[key])
    return config_class(**given) if base is None else replace(base, **given)  # type: ignore[type-var]


def read_value(key: str, value: str, kind: str) -> Any:
    """Return a value of the command line as its type; a text is taken letter by letter.

    Args:
        key: of the configuration, for messages.
        value: as typed.
        kind: ``"int"``, ``"float"``, ``"bool"`` or ``"str"``.

    Raises:
        ValueError: if it is not of this type.

    Example:
        >>> read_value("mazes", "1_000", "int"), read_value("frames", "1e6", "int")
        (1000, 1000000)
        >>> read_value("out", "007", "str"), read_value("toy", "yes", "bool")
        ('007', True)
    """
    if kind == "bool":
        if value.lower() not in BOOL_WORDS:
            raise ValueError(f"{key} is true or false; got {value!r}.")
        return value.lower() in _TRUE
    if kind == "str":
        return value
    try:
        if kind == "float":
            return float(value)
        try:
            return int(value)
        except ValueError:
            number = float(value)
            if not number.is_integer():
                raise
            return int(number)
    except (ValueError, OverflowError):
        what = "a whole number" if kind == "int" else "a number"
        raise ValueError(f"{key} must be {what}; got {value!r}.") from None


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
