"""The experiments by name. Nothing heavy is imported before one of them runs."""

from __future__ import annotations

import difflib
import importlib
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from fnmatch import fnmatch
from typing import Any

from torchrl_hmcts.trainers.runs.config import config_keys, unknown_key
from torchrl_hmcts.trainers.saving.run_folder import RunFolder


@dataclass(frozen=True)
class Experiment:
    """One experiment: its name and summary, its configuration, and what runs it.

    ``config``, ``run`` and ``evaluate``, which tests the newest checkpoint of the run in ``out``,
    are paths ``".module:name"`` in this package. ``objective`` is the figure that a sweep improves,
    larger is better unless a minus precedes it; ``progress`` the logged value by which it gives up
    trials; ``kit`` the name in ``hmcts train kit=NAME``; ``figures`` the names of a run's figures,
    nested ones joined by dots, if they are known.
    """

    name: str
    summary: str
    config: str
    run: str
    evaluate: str = ""
    objective: str = ""
    progress: str = ""
    kit: str = ""
    figures: tuple[str, ...] = ()

    @property
    def config_class(self) -> Any:
        """The dataclass of the experiment's keys."""
        return _load(self.config)

    @property
    def function(self) -> Callable[[Any], dict[str, Any]]:
        """The function that runs it; loads torch and all that the experiment needs."""
        run: Callable[[Any], dict[str, Any]] = _load(self.run)
        return run

    def check_evaluation(self) -> None:
        """Raise a ValueError if runs of the experiment cannot be evaluated again."""
        if not self.evaluate:
            raise ValueError(
                f"Runs of {self.name} cannot be evaluated again. Experiments whose runs can: "
                + ", ".join(e.name for e in ALL_EXPERIMENTS.values() if e.evaluate)
                + "."
            )

    @property
    def evaluation(self) -> Callable[[Any], dict[str, Any]]:
        """The function that evaluates a run again."""
        self.check_evaluation()
        evaluate: Callable[[Any], dict[str, Any]] = _load(self.evaluate)
        return evaluate

    def check_figure(self, name: str) -> None:
        """Raise a ValueError if runs of the experiment give no figure of that name."""
        if self.figures and not any(fnmatch(name, known) for known in self.figures):
            near = difflib.get_close_matches(name, self.figures, n=4, cutoff=0.3) or self.figures
            raise ValueError(
                f"Runs of {self.name} have no figure {name!r}. Did you mean: {', '.join(near)}?"
            )

    def __call__(self, config: Any) -> dict[str, Any]:
        """Run the experiment; return its figures."""
        return self.function(config)

    def describe(self) -> str:
        """Return its keys with their defaults and meaning, a line or two each."""
        lines = []
        for key, (default, meaning) in config_keys(self.config_class).items():
            shown = str(default).lower() if isinstance(default, bool) else default
            lines.append(f"  {key}.KEY=VALUE" if default == {} else f"  {key}={shown}")
            indent = " " * 6
            lines += textwrap.wrap(meaning, 92, initial_indent=indent, subsequent_indent=indent)
        return "\n".join(lines)


def _spreads(part: str, *names: str) -> list[str]:
    return [f"{part}.{name}.{of}" for name in names for of in ("mean", "median", "p95")]


_LAB_FIGURES = (
    *("train_seconds", "training_frames", "training_base_steps", "training_rounds"),
    *("worker_training_frames", "training_cpu_seconds", "seconds", "wrong_model.*"),
    *("test.mazes", "test.found", "test.solved", "test.frames_over_script"),
    *("test.expansions_max", "test.second_searches", "test.size", "test.plan_cpu_seconds_batched"),
    *_spreads("test", "frames", "script_frames", "plan_options", "expansions"),
    *_spreads("test", "simulated_frames", "path_cells", "plan_cpu_seconds"),
)
_OF_MAZES = ("mazes", "solved", "solved_share")
_OF_EPISODES = ("base_steps_mean", "base_steps_median", "base_steps_max", "base_steps_mean_all")
_A3C_FIGURES = (
    *("train_base_steps", "train_seconds"),
    *(f"{part}.{n}" for part in ("test", "test_greedy") for n in (*_OF_MAZES, *_OF_EPISODES)),
)
_GOALS_FIGURES = (
    *_A3C_FIGURES,
    *("test.num_plans_mean", "test.num_goals_met_mean", "test.num_divergences_mean"),
)
_ATARI_FIGURES = (
    *("score_max", "score_final", "score_mean", "frames", "base_steps", "option_steps", "c"),
    *("frames_finding_options", "frames_tuning", "frames_per_decision"),
    *("seconds", "seconds_of_this_part"),
)

_SKILLS = (".skills:run_skills", ".skills:evaluate_skills")
_GOALS = (".goals:run_goals", ".goals:evaluate_goals", "test.solved_share", "eval_solved_share")

EXPERIMENTS = {
    experiment.name: experiment
    for experiment in (
        Experiment(
            "waterworld_goals",
            "chapter 3's goal-based agent: tree search over tiles sets goals, A3C reaches them",
            ".settings:WaterworldGoalsConfig",
            *_GOALS,
            figures=_GOALS_FIGURES,
        ),
        Experiment(
            "waterworld_a3c",
            "chapter 3's comparison: A3C alone on the same mazes, network and budget",
            ".settings:WaterworldA3CConfig",
            *_GOALS,
            figures=_A3C_FIGURES,
        ),
        Experiment(
            "labmaze",
            "chapter 4: tree search over skills learned by DIAYN in DeepMind Lab's random maze",
            ".settings:LabMazeConfig",
            *_SKILLS,
            objective="test.solved",
            progress="test_solved",
            kit="labmaze",
            figures=_LAB_FIGURES,
        ),
        Experiment(
            "atari",
            "chapter 5: tree search over options on the RAM of an Atari game",
            ".atari.config:AtariConfig",
            ".atari.run:run_atari",
            ".atari.run:evaluate_atari",
            objective="score_max",
            kit="atari",
            figures=_ATARI_FIGURES,
        ),
    )
}

GYM = Experiment(
    "gym",
    "any Gymnasium env: tree search over skills that are learned there, or over its actions",
    ".gym_settings:GymConfig",
    *_SKILLS,
    objective="test.solved",
    kit="gym",
)
ANT = Experiment(
    "ant",
    "ant mazes: the kit gym, and what is known by hand of MuJoCo's ant",
    ".gym_settings:AntConfig",
    *_SKILLS,
    objective="test.solved",
    kit="ant",
)
OGBENCH = Experiment(
    "ogbench",
    "OGBench's point mazes, offline: options and their model from recorded episodes",
    ".ogbench.config:OGBenchConfig",
    ".ogbench.run:run_ogbench",
    ".ogbench.run:evaluate_ogbench",
    objective="test.solved",
    kit="ogbench",
)
DEMO = Experiment(
    "demo",
    "learn four skills and solve random mazes",
    ".settings:DemoConfig",
    *_SKILLS,
    objective="solved",
    kit="waterworld",
)
ALL_EXPERIMENTS = {
    "demo": DEMO,
    **EXPERIMENTS,
    "gym": GYM,
    "ant": ANT,
    "ogbench": OGBENCH,
}
"""The experiments of ``hmcts train``, the demo and the gym kit: all that leave a run's folder."""
KITS = {e.kit: e for e in ALL_EXPERIMENTS.values() if e.kit}
"""The experiments that ``hmcts train kit=NAME`` runs, by kit."""


def find_experiment(name: str, among: Mapping[str, Experiment] = EXPERIMENTS) -> Experiment:
    """Return an experiment by name; the nearest are named where there is none."""
    if name not in among:
        raise ValueError(unknown_key(name, among, "kit" if among is KITS else "experiment"))
    return among[name]


def recognise(run: RunFolder) -> RunFolder:
    """Return a run with what its experiment says of its keys, for its page; changed in place.

    The experiment of a run without ``run.json`` is the one that has the keys of its config.
    """
    if not run.experiment and run.config:
        known = (
            (len(keys), name)
            for name in ALL_EXPERIMENTS
            if set(run.config) <= set(keys := config_keys(ALL_EXPERIMENTS[name].config_class))
        )
        run.record["experiment"] = min(known, default=(0, ""))[1]
    if run.experiment in ALL_EXPERIMENTS:
        run.keys = config_keys(ALL_EXPERIMENTS[run.experiment].config_class)
    return run


def load_config(run: RunFolder) -> tuple[Experiment, Any]:
    """Return the experiment of a run and its configuration, with ``out`` at the folder.

    A ValueError if ``run.json`` is damaged, or the experiment is unknown or lacks one of the keys.
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
