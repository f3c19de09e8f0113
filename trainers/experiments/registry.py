"""The experiments by name. Nothing heavy is imported before one of them runs."""

from __future__ import annotations

import ast
import difflib
import importlib
import inspect
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from torchrl_hmcts.trainers.saving.run_folder import RunFolder


class ExperimentError(ValueError):
    """What an experiment was asked for does not fit what is there; the message says it all."""


@dataclass(frozen=True)
class Experiment:
    """One experiment: what it shows, how it is set up, and what runs it.

    Args:
        name: as in ``hmcts train experiment=NAME``.
        summary: one line for the list.
        config: dataclass of its keys, as ``".module:Class"``, relative to this package.
        run: function of that configuration which returns the figures, as ``".module:function"``.
        evaluate: function of a configuration, whose ``out`` is the folder of a run, that tests the
            newest checkpoint there and returns the figures; for ``hmcts evaluate``. Default: none.
        objective: figure that a sweep improves, e.g. ``"test.solved"``, larger is better; with a
            minus before it, smaller is better. Default: none, the user has to name one.
        progress: logged value by which a sweep gives up trials early. Default: none.

    Example:
        >>> find_experiment("waterworld_goals").config_class(seed=3).seed
        3
    """

    name: str
    summary: str
    config: str
    run: str
    evaluate: str = ""
    objective: str = ""
    progress: str = ""

    @property
    def config_class(self) -> Any:
        """The dataclass of the experiment's keys."""
        return _load(self.config)

    @property
    def function(self) -> Callable[[Any], dict[str, Any]]:
        """What runs it; loads torch and all that the experiment needs."""
        run: Callable[[Any], dict[str, Any]] = _load(self.run)
        return run

    @property
    def evaluation(self) -> Callable[[Any], dict[str, Any]]:
        """What evaluates a run again.

        Raises:
            ValueError: if the experiment has nothing of the kind.
        """
        if not self.evaluate:
            raise ValueError(
                f"Runs of {self.name} cannot be evaluated again. Experiments whose runs can: "
                + ", ".join(e.name for e in ALL_EXPERIMENTS.values() if e.evaluate)
                + "."
            )
        evaluate: Callable[[Any], dict[str, Any]] = _load(self.evaluate)
        return evaluate

    def __call__(self, config: Any) -> dict[str, Any]:
        """Run the experiment; return its figures."""
        return self.function(config)

    def describe(self) -> str:
        """Return its keys with their defaults and meaning, a line or two each."""
        meanings = field_docs(self.config_class)
        lines = []
        for field in fields(self.config_class):
            lines.append(f"  {field.name}={field.default}")
            lines += textwrap.wrap(
                meanings.get(field.name, ""), 92, initial_indent=" " * 6, subsequent_indent=" " * 6
            )
        return "\n".join(lines)


EXPERIMENTS = {
    experiment.name: experiment
    for experiment in (
        Experiment(
            "waterworld_goals",
            "chapter 3's goal-based agent: tree search over tiles sets goals, A3C reaches them",
            ".waterworld.config:WaterworldGoalsConfig",
            ".waterworld.run:run_waterworld",
            ".evaluations:evaluate_waterworld",
            objective="test.solved_share",
            progress="eval_solved_share",
        ),
        Experiment(
            "waterworld_a3c",
            "chapter 3's comparison: A3C alone on the same mazes, network and budget",
            ".waterworld.config:WaterworldA3CConfig",
            ".waterworld.run:run_waterworld",
            ".evaluations:evaluate_waterworld",
            objective="test.solved_share",
            progress="eval_solved_share",
        ),
        Experiment(
            "labmaze",
            "chapter 4: tree search over skills learned by DIAYN in DeepMind Lab's random maze",
            ".lab.config:LabMazeConfig",
            ".lab.run:run_labmaze",
            ".evaluations:evaluate_labmaze",
            objective="test.solved",
            progress="test_solved",
        ),
        Experiment(
            "atari",
            "chapter 5: tree search over options on the RAM of an Atari game",
            ".atari.config:AtariConfig",
            ".atari.run:run_atari",
            ".atari.run:evaluate_atari",
            objective="score_max",
        ),
    )
}

DEMO = Experiment(
    "demo",
    "learn four skills and solve random mazes",
    "..runs.config:DemoConfig",
    ".demo:run_demo",
    ".evaluations:evaluate_demo",
)
ALL_EXPERIMENTS = {"demo": DEMO, **EXPERIMENTS}
"""The experiments of ``hmcts train``, and the demo: whatever leaves a folder of a run."""


def find_experiment(name: str) -> Experiment:
    """Return an experiment by name.

    Args:
        name: one of ``EXPERIMENTS``.

    Returns:
        Where its configuration, its run and its evaluation are.

    Raises:
        ValueError: if there is none of that name; the nearest are named.

    Example:
        >>> find_experiment("labmaz")
        Traceback (most recent call last):
        ...
        ValueError: Unknown experiment 'labmaz'. Did you mean: labmaze...
    """
    if name not in EXPERIMENTS:
        near = difflib.get_close_matches(name, EXPERIMENTS, n=3, cutoff=0.4) or EXPERIMENTS
        raise ValueError(f"Unknown experiment {name!r}. Did you mean: {', '.join(near)}?")
    return EXPERIMENTS[name]


def field_docs(config_class: type) -> dict[str, str]:
    """Return the sentence below each field of a configuration, by the field's name.

    Args:
        config_class: a dataclass; fields of its base classes are included.

    Example:
        >>> from torchrl_hmcts.trainers.runs.config import DemoConfig
        >>> field_docs(DemoConfig)["gamma"]
        'Discount per base step.'
    """
    docs: dict[str, str] = {}
    for owner in reversed(config_class.__mro__[:-1]):
        tree = ast.parse(textwrap.dedent(inspect.getsource(owner)))
        body = tree.body[0].body  # type: ignore[attr-defined]
        for field, below in zip(body, body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                assert isinstance(field.target, ast.Name)
                docs[field.target.id] = " ".join(ast.literal_eval(below.value).split())
    return docs


def recognise(run: RunFolder) -> RunFolder:
    """Return a run with what its experiment says of its keys, for its page.

    The experiment of a run without ``run.json`` is the one that has the keys of its config.

    Args:
        run: of :func:`~torchrl_hmcts.trainers.saving.run_folder.read_run`; changed in place.
    """
    if not run.experiment and run.config:
        known = (
            (len(keys), name)
            for name in ALL_EXPERIMENTS
            if set(run.config) <= set(keys := config_keys(name))
        )
        run.record["experiment"] = min(known, default=(0, ""))[1]
    if run.experiment in ALL_EXPERIMENTS:
        run.keys = config_keys(run.experiment)
    return run


def config_keys(experiment: str) -> dict[str, tuple[Any, str]]:
    """Return the default and the meaning of each key of an experiment.

    Args:
        experiment: its name.

    Example:
        >>> config_keys("demo")["gamma"][1]
        'Discount per base step.'
    """
    config_class = ALL_EXPERIMENTS[experiment].config_class
    meanings = field_docs(config_class)
    return {key.name: (key.default, meanings.get(key.name, "")) for key in fields(config_class)}


def load_config(run: RunFolder) -> tuple[Experiment, Any]:
    """Return the experiment of a run and its configuration, with ``out`` at the folder.

    Args:
        run: of :func:`read_run`.

    Raises:
        ValueError: if ``run.json`` is damaged, or the experiment is unknown or no longer has one of
            the keys.
    """
    for sentence in run.damage:
        if "run.json" in sentence:
            raise ValueError(sentence)
    run = recognise(run)
    if run.experiment not in ALL_EXPERIMENTS:
        raise ValueError(
            f"{run.path} does not say which experiment it is of (run.json). Experiments: "
            f"{', '.join(ALL_EXPERIMENTS)}."
        )
    experiment = ALL_EXPERIMENTS[run.experiment]
    known = {field.name for field in fields(experiment.config_class)}
    unknown = sorted(set(run.config) - known)
    if unknown:
        raise ValueError(
            f"{run.path} was made with keys that experiment={experiment.name} no longer has: "
            f"{', '.join(unknown)}. Use the version that made it: {run.record.get('versions')}."
        )
    config = experiment.config_class(**{**run.config, "out": str(run.path)})
    return experiment, config


def _load(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module, __package__), name)
