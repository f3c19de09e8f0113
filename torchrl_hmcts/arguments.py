"""Constructors that say which argument they could not take, whatever went wrong inside.

A constructor checks what it can foresee. What it cannot foresee (text where a number belongs, a
size that torch refuses) would surface as an error of some inner line, without the argument's name.
:func:`name_arguments` looks at such an error, only once it has happened, and says what was given.
"""

from __future__ import annotations

import functools
import inspect
import linecache
import math
import numbers
import re
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal, TypeVar, Union

T = TypeVar("T", bound=type)

# What a wrong argument makes inner lines raise, besides TypeError and ValueError. Types are exact:
# FileNotFoundError, NotImplementedError or a package's own errors say what they mean.
_INNER = {
    AttributeError,
    AssertionError,
    IndexError,
    OverflowError,
    RuntimeError,
    ZeroDivisionError,
}
# What torch and numba raise as RuntimeError, though no argument is wrong.
_OF_THE_SYSTEM = re.compile(
    r"memory|No space left|Too many open files|Resource temporarily|cannot cache|"
    r"CUDA error|cuda(?:rt)? error|device-side|NCCL|Permission denied|Read-only|\[Errno ",
    re.IGNORECASE,
)


def name_arguments(cls: T) -> T:
    r"""Make a class name the arguments with which it could not be built; use it as a decorator.

    A NaN that the constructor has let pass is refused. An error that names none of the arguments is
    raised anew as ``TypeError``, naming the argument that is not what its annotation says, or, if
    none is, as ``ValueError`` with what was given. An error that names one is left as it is.

    Args:
        cls: class, of which ``__init__`` is replaced.

    Returns:
        The class itself.

    Examples:
        >>> from torchrl_hmcts.arguments import name_arguments
        >>> @name_arguments
        ... class Halves:
        ...     def __init__(self, number: int) -> None:
        ...         self.half = number / 2
        >>> Halves("six")
        Traceback (most recent call last):
        ...
        TypeError: Halves needs number: int, got 'six'.
    """
    init = vars(cls).get("__init__", cls.__init__)  # type: ignore[misc]
    if getattr(init, "_names_arguments", None) is cls:
        return cls

    @functools.wraps(init)
    def checked(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            init(self, *args, **kwargs)
        except Exception as error:
            if type(self).__init__ is not checked:  # a subclass passes its own values: it explains
                raise
            better = _explain(cls.__name__, init, (self, *args), kwargs, error)
            if better is None:
                raise
            raise better from error
        for value in (*args, *kwargs.values()):
            if isinstance(value, float) and math.isnan(value):
                _refuse_nan(cls, init, self, args, kwargs)

    checked._names_arguments = cls  # type: ignore[attr-defined]
    cls.__init__ = checked  # type: ignore[misc]
    return cls


def name_all_arguments(namespace: Mapping[str, Any], public: Iterable[str]) -> None:
    """Apply :func:`name_arguments` to the public classes of a package that have a constructor.

    Args:
        namespace: of the package, ``globals()``.
        public: its ``__all__``.

    Examples:
        >>> from torchrl_hmcts.arguments import name_all_arguments
        >>> class Box:
        ...     def __init__(self, width: float) -> None:
        ...         self.width = width + 0
        >>> name_all_arguments({"Box": Box, "size": 3}, ["Box", "size"])
        >>> Box(None)
        Traceback (most recent call last):
        ...
        TypeError: Box needs width: float, got None.
    """
    for name in public:
        value = namespace[name]
        tensorclass = getattr(value, "_is_tensorclass", False)  # a result, made in loops
        if inspect.isclass(value) and "__init__" in vars(value) and not tensorclass:
            name_arguments(value)


def _given(
    init: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> dict[str, Any]:
    """Returns the arguments of a call by name, without ``self``."""
    bound = inspect.signature(init).bind(*args, **kwargs).arguments
    given: dict[str, Any] = {}
    for name, parameter in list(inspect.signature(init).parameters.items())[1:]:
        if name in bound and parameter.kind is parameter.VAR_KEYWORD:
            given.update(bound[name])
        elif name in bound:
            given[name] = bound[name]
    return given


def _refuse_nan(
    cls: type, init: Callable[..., Any], self: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> None:
    for name, value in _given(init, (self, *args), kwargs).items():
        if isinstance(value, float) and math.isnan(value):
            raise ValueError(f"{cls.__name__} needs a number for {name}; got {value}.")


def _explain(
    owner: str,
    init: Callable[..., Any],
    args: tuple[Any, ...],
    kwargs: Mapping[str, Any],
    error: Exception,
) -> Exception | None:
    """Returns a better error, or None if this one will do."""
    if type(error).__module__.startswith("torchrl_hmcts"):  # an error of our own says it all
        return None
    outward = isinstance(error, (TypeError, ValueError))
    if not outward and (type(error) not in _INNER or _is_of_the_system(error)):
        return None
    try:
        given = _given(init, args, kwargs)
    except TypeError:  # the call itself did not fit, and Python says where
        return None
    message = str(error)
    try:
        hints = typing.get_type_hints(init)
    except Exception:  # a name that only type checkers import
        hints = {}
    wrong = [name for name, value in given.items() if not _fits(value, hints.get(name, Any))]
    inner = " cannot be built with " in message  # of a part, whose arguments are others
    named = not inner and any(_names(message, name, given[name]) for name in wrong or given)
    if outward and not inner and _is_explained(error):  # by its type, if not by name or value
        kinds = {type(given[name]).__name__ for name in wrong or given}
        named = named or any(re.search(rf"\b{re.escape(kind)}\b", message) for kind in kinds)
    if outward and (named or (not wrong and not inner and owner in message)):
        return None
    if wrong:
        annotations = inspect.get_annotations(init)
        needs = "; ".join(
            f"{name}: {annotations.get(name, hints[name])}, got {_show(given[name])}"
            for name in wrong
        )
        return TypeError(f"{owner} needs {needs}.")
    if not given:
        return None
    shown = ", ".join(f"{name}={_show(value)}" for name, value in given.items())
    return ValueError(f"{owner} cannot be built with {shown}: {type(error).__name__}: {message}")


def _is_of_the_system(error: BaseException | None) -> bool:
    """Whether the system's lack, rather than an argument, was the error or its cause."""
    while error is not None:
        if isinstance(error, (OSError, MemoryError, ImportError)):
            return True
        if isinstance(error, RuntimeError) and _OF_THE_SYSTEM.search(str(error)):
            return True
        error = error.__cause__ or error.__context__
    return False


def _is_explained(error: Exception) -> bool:
    """Whether a line of this package raised the error, rather than one that it calls."""
    frame = error.__traceback__
    while frame is not None and frame.tb_next is not None:
        frame = frame.tb_next
    if frame is None:
        return False
    code = frame.tb_frame.f_code
    line = linecache.getline(code.co_filename, frame.tb_lineno)
    ours = str(frame.tb_frame.f_globals.get("__name__", "")).startswith("torchrl_hmcts")
    return ours and line.lstrip().startswith("raise ")


def _names(message: str, name: str, value: Any) -> bool:
    if re.search(
        rf"(?<!')\b{re.escape(name)}\b", message
    ):  # 'x' in quotes is an attribute of another
        return True
    plain = isinstance(value, (str, bytes, int, float, tuple, list)) and len(repr(value)) > 1
    return plain and repr(value) in message


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value can be meant by an annotation; in doubt, yes."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return any(type(value) is type(part) and value == part for part in parts)
    if hint is float:
        return isinstance(value, numbers.Real) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if hint is None or hint is type(None):
        return value is None
    if getattr(hint, "__name__", "") == "NestedKey":
        return isinstance(value, str) or (
            isinstance(value, tuple) and bool(value) and all(_fits(key, hint) for key in value)
        )
    if hint is Any or getattr(hint, "_is_protocol", False):
        return True
    kind = origin or hint
    if not inspect.isclass(kind):
        return True
    if not isinstance(value, kind):
        return False
    if isinstance(value, (tuple, list)) and parts:
        inner = [part for part in parts if part is not Ellipsis]
        return all(any(_fits(item, part) for part in inner) for item in value)
    return True


def _show(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 and "\n" not in text else type(value).__name__
