"""Tensor classes that keep their docstring, which ``TensorClass`` replaces by their signature."""

from __future__ import annotations

from typing import Any

from tensordict.tensorclass import _TensorClassMeta


class KeepsDocstring(_TensorClassMeta):
    """Metaclass of a ``TensorClass`` whose docstring is to be seen by ``help``.

    Example:
        >>> from tensordict import TensorClass
        >>> from torch import Tensor
        >>> class Point(TensorClass, metaclass=KeepsDocstring):
        ...     '''A place in the plane.'''
        ...     position: Tensor
        >>> Point.__doc__
        'A place in the plane.'
    """

    def __new__(mcs, name: str, bases: Any, namespace: dict[str, Any], **kwargs: Any) -> Any:
        cls = super().__new__(mcs, name, bases, namespace, **kwargs)
        if "__doc__" in namespace:
            cls.__doc__ = namespace["__doc__"]
        return cls
