"""The command ``hmcts``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import fields

from torchrl_hmcts.trainers.config import DemoConfig, parse_overrides


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit status.

    Args:
        argv: words after the program's name. Default: those of the process.

    Example:
        >>> main(["demo", "sede=1"])
        2
    """
    parser = argparse.ArgumentParser(
        prog="hmcts", description="Hierarchical Monte Carlo tree search over learned skills."
    )
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    demo = verbs.add_parser(
        "demo",
        help="learn four skills and solve random mazes with them (about a minute)",
        description="Train skills in the training mazes, then solve test mazes by planning over "
        "them. Writes metrics.json, pictures, a GIF and index.html to the folder `out`.",
        epilog="keys and defaults:\n" + _list_keys(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    demo.add_argument("overrides", nargs="*", metavar="key=value", help="e.g. seed=1 out=runs/one")
    arguments = parser.parse_args(argv)
    try:
        config = parse_overrides(DemoConfig, arguments.overrides)
        from torchrl_hmcts.trainers.demo import run_demo
    except ModuleNotFoundError as error:
        return _missing(error)
    except ValueError as error:
        print(f"hmcts demo: {error}", file=sys.stderr)
        return 2
    try:
        run_demo(config)
    except OSError as error:  # e.g. a folder that cannot be written
        print(f"hmcts demo: {error}. Choose another folder with out=DIR.", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nhmcts demo: stopped; it starts anew, run it again.", file=sys.stderr)
        return 130
    return 0


def _list_keys() -> str:
    return "\n".join(f"  {field.name}={field.default}" for field in fields(DemoConfig))


def _missing(error: ModuleNotFoundError) -> int:
    print(
        f"hmcts needs {error.name}, which is not installed. Install the extra that has it: "
        "pip install 'torchrl_hmcts[train]'",
        file=sys.stderr,
    )
    return 1


if __name__ == "__main__":
    sys.exit(main())
