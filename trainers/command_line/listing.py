"""``hmcts list``."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from torchrl_hmcts.trainers.command_line.running import WRONG_WORDS, told
from torchrl_hmcts.trainers.experiments.dissertation import FIGURES
from torchrl_hmcts.trainers.experiments.registry import (
    ALL_EXPERIMENTS,
    EXPERIMENTS,
    KITS,
    find_experiment,
)


def show(words: Sequence[str]) -> int:
    """List the experiments, the keys of one, or the figures; return the exit status."""
    name = words[0] if words else ""
    with told("list", *WRONG_WORDS):
        if len(words) > 1:
            raise ValueError(f"one name at most; got {' '.join(words)!r}.")
        if name in ("", "experiments"):
            print("experiments (their keys: hmcts list NAME):")
            print(summaries())
            print(f"\nkits (hmcts train kit=NAME): {', '.join(KITS)}")
            print("figures of the dissertation: hmcts list figures")
        elif name == "figures":
            print(figures())
        else:
            print(find_experiment(name, {**EXPERIMENTS, **ALL_EXPERIMENTS, **KITS}).describe())
    return 0


def summaries() -> str:
    """Return the experiments, a line each."""
    width = max(map(len, EXPERIMENTS))
    return "\n".join(f"  {name:<{width}}  {e.summary}" for name, e in EXPERIMENTS.items())


def figures() -> str:
    """Return the figures of the dissertation, and what ours are drawn from."""
    lines = []
    for figure in FIGURES.values():
        lines.append(f"  {figure.name:<9} {figure.shows}")
        lines += textwrap.wrap(
            f"ours: {figure.data}", 92, initial_indent=" " * 12, subsequent_indent=" " * 12
        )
    return "\n".join(lines)
