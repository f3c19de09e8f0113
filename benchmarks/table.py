"""The frame of the benchmarks: arguments, one JSON file of figures, one table in markdown."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import torch


def read_arguments(
    text: str, quick: Mapping[str, Any], *, seeds: list[int], **options: Any
) -> argparse.Namespace:
    """Read ``--seeds``, ``--quick``, ``--out`` and an option for each keyword; use one thread.

    Args:
        text: of the script; its first line says what it is.
        quick: values that ``--quick`` puts in place of others.
        seeds: default.
        **options: defaults, or pairs of a default and a help text. A list takes several values.
    """
    parser = argparse.ArgumentParser(description=text.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    parser.add_argument("--quick", action="store_true", help="small, to see that it works")
    for name, given in {"seeds": seeds, **options}.items():
        default, note = given if isinstance(given, tuple) else (given, None)
        several = isinstance(default, list)
        kind = type(default[0] if several else default)
        parser.add_argument(
            f"--{name.replace('_', '-')}",
            type=str if default is None else kind,
            default=default,
            nargs="+" if several else None,
            help=note,
        )
    arguments = parser.parse_args()
    if arguments.quick:
        vars(arguments).update(quick)
    torch.set_num_threads(1)
    return arguments


def markdown(rows: Iterable[Any], columns: Mapping[str, Callable[[Any], Any]]) -> str:
    """Return a table with a line for each row; a column is a heading and what to write in it."""
    lines = [list(columns), ["---"] * len(columns)]
    lines += [[str(cell(row)) for cell in columns.values()] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def write(arguments: argparse.Namespace, figures: Any) -> None:
    """Write the figures to ``--out``, if it was given."""
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(figures, indent=1, default=str) + "\n")


def add_row(path: Path, row: Mapping[str, Any], *keys: str, **facts: Any) -> None:
    """Write a row into a file of rows, in place of that with the same values of the keys."""
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"] if path.exists() else []
    rows = [other for other in rows if any(other[key] != row[key] for key in keys)]
    text = json.dumps({**facts, "rows": [*rows, row]}, indent=1)
    path.write_text(text + "\n", encoding="utf-8")
