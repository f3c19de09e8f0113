"""The command ``hmcts``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

from torchrl_hmcts.trainers.config import parse_overrides
from torchrl_hmcts.trainers.experiments.registry import EXPERIMENTS, Experiment, find_experiment

_DEMO = Experiment(
    "demo", "learn four skills and solve random mazes", "..config:DemoConfig", "..demo:run_demo"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit status.

    Args:
        argv: words after the program's name. Default: those of the process.

    Example:
        >>> main(["demo", "sede=1"])
        2
    """
    arguments = _parser().parse_args(argv)
    run: Callable[[argparse.Namespace], int] = arguments.run
    return run(arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hmcts", description="Hierarchical Monte Carlo tree search over learned skills."
    )
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    raw = argparse.RawDescriptionHelpFormatter
    demo = verbs.add_parser(
        "demo",
        help="learn four skills and solve random mazes with them (about a minute)",
        description="Train skills in the training mazes, then solve test mazes by planning over "
        "them. Writes\nmetrics.json, pictures, a GIF and index.html to the folder `out`.",
        epilog="keys and defaults:\n" + _DEMO.describe(),
        formatter_class=raw,
    )
    demo.add_argument("overrides", nargs="*", metavar="key=value", help="e.g. seed=1 out=runs/one")
    demo.set_defaults(run=lambda arguments: _run("demo", _DEMO, arguments.overrides))
    train = verbs.add_parser(
        "train",
        help="run an experiment: hmcts train experiment=NAME key=value ...",
        description="Train and evaluate one experiment. Writes metrics.json, curves.csv, pictures, "
        "checkpoints\nand index.html to the folder `out`; `resume=true` goes on where a run "
        "stopped.",
        epilog="experiments (their keys: hmcts list NAME):\n" + _summaries(),
        formatter_class=raw,
    )
    train.add_argument("words", nargs="+", metavar="key=value", help="experiment=NAME first")
    train.set_defaults(run=_train)
    show = verbs.add_parser(
        "list",
        help="list the experiments, or the keys of one",
        description="List the experiments, or the keys of one with their defaults and meaning.",
    )
    show.add_argument("experiment", nargs="?", metavar="NAME")
    show.set_defaults(run=_list)
    return parser


def _train(arguments: argparse.Namespace) -> int:
    names = [w.partition("=")[2] for w in arguments.words if w.startswith("experiment=")]
    if len(names) != 1:
        return _refuse(
            "train", f"say once which experiment, e.g. experiment={next(iter(EXPERIMENTS))}"
        )
    try:
        experiment = find_experiment(names[0])
    except ValueError as error:
        return _refuse("train", error)
    overrides = [word for word in arguments.words if not word.startswith("experiment=")]
    return _run(f"train experiment={experiment.name}", experiment, overrides)


def _list(arguments: argparse.Namespace) -> int:
    if arguments.experiment is None:
        print(_summaries())
        return 0
    try:
        print(find_experiment(arguments.experiment).describe())
    except ValueError as error:
        return _refuse("list", error)
    return 0


def _run(command: str, experiment: Experiment, overrides: Sequence[str]) -> int:
    """Check the keys, run, and turn what can go wrong for users into one line."""
    try:
        config = parse_overrides(experiment.config_class, overrides)
        _ = experiment.function
    except ModuleNotFoundError as error:
        return _missing(error)
    except ValueError as error:
        return _refuse(command, error)
    try:
        experiment(config)
    except OSError as error:  # e.g. a folder that cannot be written
        print(f"hmcts {command}: {error}. Choose another folder with out=DIR.", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"\nhmcts {command}: stopped; {_going_on(command, config)}", file=sys.stderr)
        return 130
    return 0


def _going_on(command: str, config: Any) -> str:
    if hasattr(config, "resume"):
        return f"go on with: hmcts {command} out={config.out} resume=true"
    return "it starts anew, run it again."


def _summaries() -> str:
    width = max(map(len, EXPERIMENTS))
    return "\n".join(f"  {name:<{width}}  {e.summary}" for name, e in EXPERIMENTS.items())


def _refuse(command: str, message: object) -> int:
    print(f"hmcts {command}: {message}", file=sys.stderr)
    return 2


def _missing(error: ModuleNotFoundError) -> int:
    print(
        f"hmcts needs {error.name}, which is not installed. Install the extra that has it: "
        "pip install 'torchrl_hmcts[train]'",
        file=sys.stderr,
    )
    return 1


if __name__ == "__main__":
    sys.exit(main())
