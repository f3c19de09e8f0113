"""Kits: each is all that an experiment must know of an environment.

The recipe :mod:`~torchrl_hmcts.trainers.experiments.skills` does the rest with any kit; one of your
own is a subclass of :class:`Kit` with ``make_training_env``, ``make_env``, ``starts``.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.objectives import LossModule

from torchrl_hmcts.checks import instance
from torchrl_hmcts.planners import PUCT, MCTSPlanner, PolicyValueEvaluator
from torchrl_hmcts.trainers.diayn import worker_losses
from torchrl_hmcts.trainers.evaluation import (
    Results,
    act_by_policy,
    option_reach,
    plan_and_execute,
)
from torchrl_hmcts.trainers.experiments.kits.showing import (
    CAPTIONS,
    LearnedSkills,
    Trial,
    draw_run,
    start_to_show,
    write_film,
)
from torchrl_hmcts.trainers.experiments.settings import SkillsConfig
from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.manager import make_manager, scale_by
from torchrl_hmcts.trainers.parts import build, merged
from torchrl_hmcts.trainers.runs import console
from torchrl_hmcts.trainers.runs.config import ExperimentError
from torchrl_hmcts.transforms import OptionTransform

__all__: list[str] = []

KITS = {
    "waterworld": "waterworld.WaterworldKit",
    "labmaze": "lab.LabMazeKit",
    "gym": "gym.GymKit",
    "ant": "ant.AntKit",
}
"""Class of each kit by its name on the command line, in this package."""


RADIUS_SHARE = 0.75
"""Novelty radius, as a share of how far learned options move the features."""
OBJECTIVE = {"_component_": "torchrl_hmcts.objectives.SkillDiscriminatorLoss"}
"""DIAYN's objective, the default of every kit."""

Curve = tuple[Any, Sequence[float]]  # steps and values


class Kit:
    """Base class of kits: all that an experiment must know of an environment.

    A split is ``"train"``, ``"curve"`` (tried while it learns) or ``"test"``.

    Args:
        config: keys of the experiment.

    Attributes:
        place_key (NestedKey): where the agent is: what the displacement and a place's novelty are
            about.
        worker_keys (sequence of NestedKey): what the worker sees besides its skill.
        state_keys (sequence of NestedKey): what pictures need of a state.
        captions (mapping): of the pictures.
        start_name (str): what starts are called; the first word is their unit, in the plural.
        unit (str): of the times that are reported.
        curve_steps (str): column of the steps in ``curves.csv``, named for their unit.
        title (str): of the page.
        group (int): starts that are planned side by side.
        replans (bool): whether it plans before every option, rather than execute one plan.
        can_be_solved (bool): whether it is known what counts as solved.
        shorter_paths (bool): whether a search accepts a shorter way to a place it knows.
        learning_options (int): options that a guided search simulates while the manager learns: a
            long search costs more than it teaches. 0: those of the budget.

    Example:
        >>> from torchrl_hmcts.trainers.experiments.settings import DemoConfig
        >>> kit = make_kit(DemoConfig(mazes=3))
        >>> kit.place_key, len(kit.starts("test", 3))
        ('position', 3)
    """

    place_key: NestedKey = "position"
    worker_keys: Sequence[NestedKey] = ("observation",)
    state_keys: Sequence[NestedKey] = ("position",)
    captions: Mapping[str, str] = CAPTIONS
    start_name = "mazes that the worker has never seen"
    unit = "base steps"
    curve_steps = "base_steps"
    title = "Planning over learned skills"
    group = 38
    replans = False
    can_be_solved = True
    shorter_paths = False
    learning_options = 0

    def __init__(self, config: Any) -> None:
        self.config: SkillsConfig = config
        self.manager: TensorDictModuleBase | None = None  # guides the planner once it is learned
        self._encoder: TensorDictModuleBase | None = None

    # ------------------------------------------------------- envs: what every kit has

    def make_training_env(self, num_envs: int = 32) -> EnvBase:
        """Return the env to learn skills in: copies under a ``SkillTransform``."""
        raise NotImplementedError

    def make_loss(self) -> LossModule | None:
        """Return the worker's loss, of networks that keys cannot describe; None: the keys' loss."""
        return None

    def trainer_part(self, loss: LossModule) -> dict[str, Any]:
        """Return keywords of the trainer of a loss at the kit's defaults."""
        return {}

    def make_env(self, split: str) -> EnvBase:
        """Return a base env of a split to act in."""
        raise NotImplementedError

    def starts(self, split: str, num_starts: int) -> TensorDictBase:
        """Return states of a split to act from, ``[num_starts]``."""
        raise NotImplementedError

    def make_options(
        self,
        env: EnvBase,
        worker: TensorDictModuleBase,
        trajectory_keys: Any = None,
        *,
        gamma: float | None = None,
    ) -> EnvBase:
        """Return the macro env over a base env, whose actions are the options that a worker
        executes.

        ``trajectory_keys`` are base transitions to hand out, see ``OptionTransform``; ``gamma``,
        the discount per base step of its rewards, is by default the configuration's.
        """
        config, stall = self.config, self.stall(env)
        options = OptionTransform(
            worker,
            config.num_skills,
            config.option_steps,
            config.gamma if gamma is None else gamma,
            None if stall is None else stall[1],
            trajectory_keys=trajectory_keys,
        )
        return TransformedEnv(env, options if stall is None else Compose(stall[0], options))

    def stall(self, env: EnvBase) -> tuple[Any, Any] | None:
        """Return what notices, and what ends, an option at a standstill; None for none."""
        return None

    def given_worker(self) -> TensorDictModuleBase | None:
        """Return the worker of options that need no learning; None where they are learned.

        With ``options="actions"`` an option repeats one action.

        Raises:
            ExperimentError: if the actions cannot be counted.
        """
        if self.config.options == "learned":
            return None
        space = self.make_env("test").action_spec.space
        if not hasattr(space, "n"):
            raise ExperimentError(
                "options=actions needs discrete actions; these are within bounds."
            )
        self.config = replace(self.config, num_skills=int(space.n))
        return TensorDictModule(lambda skill: skill, ["skill"], ["action"])

    def prepare(self, worker: TensorDictModuleBase) -> None:
        """Take note of a worker before it is planned with, e.g. of how far its options reach.

        With ``features="learned"`` the novelty radius becomes three quarters of that.
        """
        if self.config.features == "learned":
            reach = self.reach(self.make_simulator(worker, "train"), self.starts("train", 8))
            if reach > 0.0:  # a worker may stand still before it has learned
                self.config = replace(self.config, novelty_radius=RADIUS_SHARE * reach)

    def reach(self, simulator: EnvBase, starts: TensorDictBase) -> float:
        """Return how far options move the novelty test's features, see :func:`option_reach`."""
        novelty: Any = self.make_planner(simulator).novelty
        return option_reach(simulator, starts, novelty.features, self.config.num_skills)

    def note(self, loss: LossModule) -> None:
        """Take note of the learned networks, which ``features="learned"`` compares."""
        objective: Any = getattr(loss, "objective", None)
        network = getattr(objective, "encoder", getattr(objective, "discriminator", None))
        self._encoder = network

    def novelty_part(self) -> dict[str, Any] | None:
        """Return the entries of the planner's novelty test at the kit's defaults, by keyword."""
        config = self.config
        if config.features == "none":
            return None
        part: dict[str, Any] = {"_component_": "torchrl_hmcts.planners.RadiusNovelty"}
        part |= {"key": self.place_key, "radius": config.novelty_radius}
        if self.shorter_paths:
            part["shorter_paths"] = True
        if config.features == "learned" and self._encoder is not None:
            part |= {"key": self._encoder.out_keys[0], "encoder": self._encoder}
        return part

    def make_simulator(self, worker: TensorDictModuleBase, split: str = "test") -> EnvBase:
        """Return the macro env to plan in."""
        return self.make_options(self.make_env(split), worker)

    def make_real(
        self, worker: TensorDictModuleBase, trajectory_keys: Any = None, split: str = "test"
    ) -> EnvBase:
        """Return the macro env to act in; its rewards are not discounted."""
        return self.make_options(self.make_env(split), worker, trajectory_keys, gamma=1.0)

    # ------------------------------------------------------- the planner

    def planner_part(self) -> dict[str, Any]:
        """Return the entries of the planner at the kit's defaults, by keyword.

        With ``manager="four_stages"`` they are the dissertation's (section 2.4.2): UCT, expansion
        of one option, a simulation of ten random options from there, backup of the mean.
        """
        config, planners = self.config, "torchrl_hmcts.planners"
        part: dict[str, Any] = {
            "_component_": f"{planners}.MCTSPlanner",
            "budget": {
                "_component_": f"{planners}.SearchBudget",
                "expansions": config.expansions,
            },
        }
        if config.manager != "four_stages":
            own = {"novelty": self.novelty_part(), "leaves_per_wave": config.leaves_per_wave}
            return part | own
        return part | {
            "tree_policy": {"_component_": f"{planners}.UCT"},
            "leaf_evaluator": {"_component_": f"{planners}.RolloutEvaluator"},
            "expand": "one",
        }

    def parts(self) -> dict[str, dict[str, Any]]:
        """Return the components that keys of the command line change, at the kit's defaults."""
        trainer = {"hmcts": "HMCTSTrainer"}.get(self.config.algorithm, "DIAYNTrainer")
        with torch.random.fork_rng(devices=[]):  # a new env draws its seed
            losses = worker_losses(self.make_training_env(1).action_spec_unbatched)
        other = merged(OBJECTIVE, self.config.objective) != OBJECTIVE
        return {
            "objective": dict(OBJECTIVE),
            "loss": {
                "_component_": f"torchrl_hmcts.objectives.{losses[-1 if other else 0].__name__}"
            },
            "trainer": {"_component_": f"torchrl_hmcts.trainers.{trainer}"},
            "planner": self.planner_part(),
        }

    def make_planner(self, simulator: EnvBase, **budget: Any) -> MCTSPlanner:
        """Return the planner that the configuration describes, with changes of its
        ``SearchBudget``.
        """
        encoder = self._encoder
        if self.config.features == "learned" and (
            encoder is None or "displacement" in encoder.in_keys
        ):
            raise ExperimentError(
                "features=learned compares what the objective's network says of a state; this one "
                "reads none. Add objective=metra, or objective_key=observation."
            )
        part = merged(self.planner_part(), self.config.planner)
        part["budget"] = {**part["budget"], **budget}
        planner: MCTSPlanner = build(**part, env=simulator)
        return planner if self.manager is None else self.guide(planner, self.manager)

    @property
    def manager_keys(self) -> Sequence[NestedKey]:
        """Entries of the states that a network for the manager reads; empty if there is none."""
        return ()

    def make_round_planner(self, simulator: EnvBase, **own: Any) -> MCTSPlanner:
        """Return the planner of Algorithm 3's training rounds: bare, with the keys of ``planner``.

        ``own`` is what the trainer sets; another ``tree_policy`` of the configuration goes first.
        """
        bare: dict[str, Any] = {
            "_component_": "torchrl_hmcts.planners.MCTSPlanner",
            "novelty": self.planner_part().get("novelty"),
            "budget": {"_component_": "torchrl_hmcts.planners.SearchBudget"},
        }
        if bare["novelty"] is not None:
            bare["novelty"] |= {"shorter_paths": False}
        part = merged(bare, self.config.planner)
        part["budget"] = {**part["budget"], "expansions": self.config.round_expansions}
        planner: MCTSPlanner = build(**{**own, **part, "seed": own["seed"]}, env=simulator)
        return planner

    def second_try(self) -> Kit | None:
        """Return the kit with which starts without a plan are searched again; None for none."""
        return None

    def manager_network(
        self, planner: MCTSPlanner, split: str, *, scale: bool = True
    ) -> TensorDictModuleBase:
        """Return an untrained network for the manager: logits of the options, value of a state.

        With ``scale`` its inputs are scaled by the states that a few searches meet.

        Raises:
            ExperimentError: if the states have nothing of which a network can learn.
        """
        if not self.manager_keys:
            raise ExperimentError(
                f"{self.title}: the planner sees features of which no network can learn. Choose an "
                "env whose observation shows its state, or leave manager as it is."
            )
        network = make_manager(planner, self.manager_keys, bounded=not self.replans)
        if scale:
            scale_by(network, planner, self.starts(split, 4))
        return network

    def manager_for(self, network: TensorDictModuleBase, split: str) -> TensorDictModuleBase:
        """Return a manager's network for the mazes of another split, with the same weights."""
        return network

    def guide(self, planner: MCTSPlanner, network: TensorDictModuleBase) -> MCTSPlanner:
        """Return a planner with the prior and the values of a network."""
        guide = PolicyValueEvaluator(network, uniform_share=0.05)
        return MCTSPlanner(
            planner.simulator.given_env,
            tree_policy=PUCT(c=0.3),
            leaf_evaluator=guide,
            backup="max",
            novelty=planner.novelty,
            expand="one",
            budget=planner.budget,
        )

    def describe(self) -> str:
        """Return what the kit found out about the env, to print at the beginning of a run."""
        return ""

    def act_by(self, policy: TensorDictModuleBase, real: EnvBase, start: TensorDictBase) -> Results:
        """Act in one episode without a search, see :func:`act_by_policy`."""
        return act_by_policy(policy, real, start, limit=self.config.max_frames)

    def act(
        self,
        planner: MCTSPlanner,
        real: EnvBase,
        starts: TensorDictBase,
        keys: Sequence[NestedKey] = (),
    ) -> Results:
        """Plan from each start ``[M]`` and execute the plan; ``keys`` are entries to return."""
        return plan_and_execute(planner, real, starts, group=self.group, keys=keys)

    # ------------------------------------------------------- figures and pages

    def path_lengths(self, starts: TensorDictBase) -> np.ndarray:
        """Return a measure of how far each start is from its goal, for the choice of pictures."""
        return np.zeros(len(starts))

    def figures(self, trial: Trial) -> dict[str, Any]:
        """Return the figures of a trial; what counts as solved is a terminal state."""
        return trial.results.summary()

    def extras(self, worker: TensorDictModuleBase) -> dict[str, Any]:
        """Return the figures of further tests, by name."""
        return {}

    def metrics(self, learned: LearnedSkills, trial: Trial) -> dict[str, Any]:
        """Return the figures of a run."""
        return {
            "training_base_steps": learned.steps,
            "training_rounds": learned.rounds,
            "worker_base_steps": learned.worker_step,
            "training_cpu_seconds": learned.seconds,
            "test": self.figures(trial),
        }

    def curves(self, learned: LearnedSkills) -> dict[str, Curve]:
        """Return the curves of a training by name."""
        return {
            name: (np.linspace(0, learned.steps, len(values), endpoint=False), values)
            for name, values in learned.history.items()
        }

    def map(self, env: EnvBase) -> Any:
        """Return a ``MapDrawing`` that draws the states of a base env; None if there is none."""
        return None

    def draw(self, pictures: Pictures, learned: LearnedSkills, trial: Trial) -> None:
        """Draw the pictures of a run: an episode, its search, the skills, their training."""
        draw_run(self, pictures, learned, trial)

    def replay(self, worker: TensorDictModuleBase, trial: Trial) -> tuple[int, Results, Any]:
        """Play an episode again to show it; return which start, the episode, and its search."""
        shown = start_to_show(trial, self.path_lengths(trial.starts))
        episode = self.film(worker, trial.planner, trial.starts[shown : shown + 1])
        return shown, episode, trial.planner.last_search

    def film(
        self,
        worker: TensorDictModuleBase,
        planner: MCTSPlanner,
        start: TensorDictBase,
        *,
        render: str = "",
    ) -> Results:
        """Act in one episode from a start ``[1]``; keep its states and options, base step by base
        step.

        ``render="human"`` shows it in a window, ``"rgb_array"`` keeps the env's own pictures; of an
        env that draws any.
        """
        if render == "human":
            raise ValueError(f"{self.title}: no window. Leave render out, or write a film: out=.")
        keys = list(self.state_keys)
        return self.act(planner, self.make_real(worker, keys), start, keys)

    def write_film(self, episode: Results, path: str | Path) -> None:
        """Write an episode of :meth:`film` as a GIF, and as a video beside it."""
        write_film(self.map(self.make_env("test")), episode, path)

    def rows(self) -> list[tuple[str, str]]:
        """Return names and formats of the figures in the table that ends a run."""
        return [
            ("starts solved at the first trial", "{test[solved]} of {test[starts]}"),
            ("base steps of training", "{training_base_steps:,}"),
            ("CPU seconds of training", "{training_cpu_seconds:,.1f}"),
            ("simulated base steps per plan, median", "{test[simulated_steps][median]:,.0f}"),
            ("options per plan, median", "{test[plan_options][median]:.0f}"),
            ("base steps per episode, median", "{test[episode_steps][median]:,.0f}"),
            ("seconds of the run", "{seconds:,.1f}"),
        ]

    def table(self, metrics: Mapping[str, Any]) -> str:
        """Return the table that ends a run."""
        return console.table([(name, form.format(**metrics)) for name, form in self.rows()])


def make_kit(config: SkillsConfig, *env: Any) -> Kit:
    """Return the kit of a configuration, which names it by its ``KIT``.

    Args:
        config: keys of the experiment.
        *env: of a kit of Gymnasium envs, a function that makes the env instead of its id.

    Example:
        >>> from torchrl_hmcts.trainers.experiments.settings import DemoConfig
        >>> type(make_kit(DemoConfig())).__name__
        'WaterworldKit'
    """
    instance("make_kit", "config", config, SkillsConfig)
    path = f"{__name__}.{KITS[config.KIT]}"
    module, _, name = path.rpartition(".")
    kit: Kit = getattr(importlib.import_module(module), name)(config, *env)
    return kit
