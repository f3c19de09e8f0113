"""Objects as notebooks show them: a short text, and below it a picture."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tensordict import TensorClass

_TensorClassType: Any = type(TensorClass)


class KeepsDocstring(_TensorClassType):  # type: ignore[misc]
    """Metaclass of a ``TensorClass`` that keeps its docstring and repr; tensordict's does not."""

    def __new__(mcs, name: str, bases: Any, namespace: dict[str, Any], **kwargs: Any) -> Any:
        cls = super().__new__(mcs, name, bases, namespace, **kwargs)
        for kept in {"__doc__", "__repr__"} & set(namespace):
            setattr(cls, kept, namespace[kept])
        return cls


def shown(text: str, draw: Callable[[Any], object] | None = None, **figure: Any) -> str:
    """Return a text and a picture as HTML, for ``_repr_html_``.

    Args:
        text: shown as it is.
        draw: called with axes of matplotlib. Without matplotlib, or where it cannot draw, the text
            stands alone.
        **figure: of ``matplotlib.figure.Figure``.
    """
    picture = "" if draw is None else _picture(draw, figure)
    return f"<pre>{html.escape(text)}</pre>{picture}"


def draw_losses(axes: Any, history: Mapping[str, Sequence[float]]) -> None:
    """Draw the logged losses of a training; without any, raise a ``LookupError``."""
    losses = {name: values for name, values in history.items() if "loss" in name and len(values)}
    if not losses:
        raise LookupError("nothing was logged")
    for name, values in losses.items():
        axes.plot(values, label=name, linewidth=1.2)
    axes.set_xlabel("log entries")
    axes.legend(fontsize=8)


def _picture(draw: Callable[[Any], object], options: dict[str, Any]) -> str:
    try:
        from matplotlib.figure import Figure

        figure = Figure(**{"figsize": (5.0, 4.0), "layout": "constrained", **options})
        draw(figure.subplots())
        file = io.BytesIO()
        figure.savefig(file, dpi=90)
    except (ImportError, ValueError, LookupError):  # e.g. the states have no position
        return ""
    return f'<img src="data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}">'
