"""Configurations of runs as dataclasses, and their keys as they are typed."""

from __future__ import annotations

import ast
import difflib
import importlib
import inspect
import math
import numbers
import os
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any, ClassVar, TypeVar

C = TypeVar("C")

LOGGERS = ("csv", "tensorboard", "wandb")
MAX_SEED = 2**32 - 1
_TRUE, _FALSE = ("true", "yes", "on", "1"), ("false", "no", "off", "0")
BOOL_WORDS = (*_TRUE, *_FALSE)
_NUMBERS: Mapping[str, tuple[type, type, str]] = {  # plain type, all that count, in words
    "int": (int, numbers.Integral, "a whole number"),
    "float": (float, numbers.Real, "a number"),
}


class ExperimentError(ValueError):
    """An experiment was asked for what does not fit what is there; the message says it all."""


@dataclass
class RunConfig:
    """Keys that every run has; the configurations of the experiments extend it.

    Whole numbers may be NumPy's, paths may be ``Path`` objects, and a ``~`` at the start of a path
    is the home folder, once and for all.
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

    EXPERIMENT: ClassVar[str] = ""  # name of the experiment
    TOY: ClassVar[Mapping[str, Any]] = {}  # what toy=true changes
    KEPT: ClassVar[tuple[str, ...]] = ("seed", "toy")  # a run that is resumed keeps these
    PATHS: ClassVar[tuple[str, ...]] = ("out",)
    ALIASES: ClassVar[Mapping[str, str]] = {}  # other names of keys on the command line
    LEAST: ClassVar[Mapping[str, int]] = {}  # least value of a number; of whole ones 1 if not here
    ABOVE_ZERO: ClassVar[tuple[str, ...]] = ()
    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {}

    def __post_init__(self) -> None:
        kinds = key_kinds(type(self))
        for field in fields(self):
            value = _checked(field.name, kinds[field.name], getattr(self, field.name))
            if field.name in self.PATHS:
                value = home(value)
            setattr(self, field.name, value)
        if not self.out:
            raise ValueError("out is empty; name a folder, e.g. out=runs/mine.")
        if not 0 <= self.seed <= MAX_SEED:
            raise ValueError(f"seed must be 0 to {MAX_SEED}; got {self.seed}.")
        whole = dict.fromkeys((name for name, kind in kinds.items() if kind == "int"), 1)
        for name, least in {**whole, "seed": 0, **self.LEAST}.items():
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}; got {getattr(self, name)}.")
        for name in self.ABOVE_ZERO:
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be above 0; got {getattr(self, name)}.")
        if not 0.0 < getattr(self, "gamma", 1.0) <= 1.0:
            raise ValueError(f"gamma must be in (0, 1]; got {self.gamma}.")  # type: ignore[attr-defined]
        for name, choices in {"logger": LOGGERS, **self.CHOICES}.items():
            if getattr(self, name, choices[0]) not in choices:
                raise ValueError(
                    f"{name} is one of {', '.join(choices)}; got {getattr(self, name)!r}."
                )

    def check_inputs(self) -> None:
        """Check what the run needs from outside, before anything is written."""
        logger = getattr(self, "logger", "csv")
        if logger != "csv":
            need_package(logger)

    def sized(self: C) -> C:
        """Return the configuration that is run: with ``toy`` a small one."""
        return replace(self, **self.TOY) if self.toy else self  # type: ignore[attr-defined, type-var]


def _checked(name: str, kind: str, value: Any) -> Any:
    """A value of a field as the plain Python type that its annotation says."""
    if kind == "bool":
        if not isinstance(value, bool) and type(value).__name__ not in ("bool_", "bool"):
            raise TypeError(f"{name} is true or false; got {value!r}.")
        return bool(value)
    if kind in _NUMBERS:
        plain, abstract, what = _NUMBERS[kind]
        if not isinstance(value, abstract) or isinstance(value, bool):
            raise TypeError(f"{name} must be {what}; got {value!r}.")
        number: Any = value
        if not math.isfinite(number):
            raise ValueError(f"{name} must be a finite number; got {value!r}.")
        return plain(number)
    if kind == "dict":
        if not isinstance(value, Mapping):
            raise TypeError(f"{name} must be a dict of changes; got {value!r}.")
        return dict(value)
    value = os.fspath(value) if isinstance(value, os.PathLike) else value
    if not isinstance(value, str):
        raise TypeError(f"{name} must be a string; got {value!r}.")
    if "\0" in value:
        raise ValueError(f"{name} must not hold a zero byte; got {value!r}.")
    return value


def home(path: str) -> str:
    """Return a path as it was typed, with a ``~`` at its start replaced by the home folder."""
    expanded = os.path.expanduser(path)
    if path.partition("/")[0] == "~" and expanded == path:
        raise ValueError(f"{path!r} begins with ~, but no home folder is known; type the path out.")
    return expanded


def need_package(name: str) -> None:
    """Import an optional package, so that its absence is noticed before a run begins."""
    module = importlib.import_module(name)
    if getattr(module, "__file__", None) is None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)


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
    """
    types = key_kinds(config_class)
    given: dict[str, Any] = {}
    for word in overrides:
        word = word.removeprefix("env.")
        key, separator, value = word.partition("=")
        key = getattr(config_class, "ALIASES", {}).get(key, key)
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
    if kind not in _NUMBERS:
        raise ValueError(f"{key} is a group of keys: write {key}.NAME=VALUE; got {value!r}.")
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
        raise ValueError(f"{key} must be {_NUMBERS[kind][2]}; got {value!r}.") from None


def unknown_key(key: str, known: Iterable[str], what: str = "key") -> str:
    """Return the sentence that refuses a word and names the nearest ones."""
    known = list(known)
    near = difflib.get_close_matches(key, known, n=3, cutoff=0.4) or known
    return f"Unknown {what} {key!r}. Did you mean: {', '.join(near)}?"


def key_kinds(config_class: type) -> dict[str, str]:
    """Return the types of a configuration's keys: int, float, bool, str or dict."""
    kinds = {field.name: field.type for field in fields(config_class)}
    return {
        name: str(getattr(kind, "__name__", kind)).partition("[")[0] for name, kind in kinds.items()
    }


def config_keys(config_class: type) -> dict[str, tuple[Any, str]]:
    """Return the default of each key of a configuration, and the sentence below it."""
    docs: dict[str, str] = {}
    for owner in reversed(config_class.__mro__[:-1]):
        tree = ast.parse(textwrap.dedent(inspect.getsource(owner)))
        body = tree.body[0].body  # type: ignore[attr-defined]
        for field, below in zip(body, body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                assert isinstance(field.target, ast.Name)
                docs[field.target.id] = " ".join(ast.literal_eval(below.value).split())
    return {
        field.name: ({} if field.default is MISSING else field.default, docs.get(field.name, ""))
        for field in fields(config_class)
    }
