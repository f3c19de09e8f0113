"""``hmcts list``."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from torchrl_hmcts.trainers.command_line.running import missing, refuse
from torchrl_hmcts.trainers.experiments.dissertation import FIGURES
from torchrl_hmcts.trainers.experiments.registry import DEMO, EXPERIMENTS, find_experiment


def show(words: Sequence[str]) -> int:
    """List the experiments, the keys of one, or the figures; return the exit status."""
    if len(words) > 1:
        return refuse("list", f"one name at most; got {' '.join(words)!r}.")
    name = words[0] if words else ""
    try:
        if name in ("", "experiments"):
            print("experiments (their keys: hmcts list NAME):")
            print(summaries())
            print("\nfigures of the dissertation: hmcts list figures")
        elif name == "figures":
            print(figures())
        elif name == "demo":
            print(DEMO.describe())
        else:
            print(find_experiment(name).describe())
    except ModuleNotFoundError as error:
        return missing(error)
    except ValueError as error:
        return refuse("list", error)
    return 0


def summaries() -> str:
    """Return the experiments, a line each."""
    width = max(map(len, EXPERIMENTS))
    return "\n".join(f"  {name:<{width}}  {e.summary}" for name, e in EXPERIMENTS.items())


def figures() -> str:
    """Return the figures of the dissertation: what each shows there, and what ours is drawn from.

    Example:
        >>> print(figures().splitlines()[0])
          3.1       Waterworld: a random maze with the player and the target
    """
    lines = []
    for figure in FIGURES.values():
        lines.append(f"  {figure.name:<9} {figure.shows}")
        lines += textwrap.wrap(
            f"ours: {figure.data}", 92, initial_indent=" " * 12, subsequent_indent=" " * 12
        )
    return "\n".join(lines)
