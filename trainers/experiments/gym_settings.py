"""Keys of the experiments on Gymnasium envs. Nothing heavy is imported."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from torchrl_hmcts.trainers.experiments.settings import BATCH_STEPS, SkillsConfig
from torchrl_hmcts.trainers.runs.config import ExperimentError


@dataclass
class GymConfig(SkillsConfig):
    """Keys of ``hmcts train kit=gym env.id=NAME``: the agent over the kit ``gym``."""

    out: str = "runs/gym"
    id: str = ""
    """Id of the Gymnasium env, e.g. env.id=PointMaze_Large-v3."""
    make: dict[str, Any] = field(default_factory=dict)
    """Keywords of gymnasium.make: make.KEY=VALUE, e.g. make.maze_map=[[1,1],[1,1]]."""
    options: str = "learned"
    """"learned": the manager plans over skills; "actions": over primitive actions, each repeated;
    "directions": the same, where actions lie within bounds; "goals": over values that features are
    brought to, of the features that actions control."""
    task: str = "auto"
    """"goal": plan until it is reached; "return": collect rewards, with a search before every
    option; "auto": found by a short look at the env."""
    mazes: int = 20
    """Starts to act from."""
    num_skills: int = 8
    option_steps: int = 0  # type: ignore[misc]
    """Base steps of an option; 0: found by a short look at the env."""
    skill_steps: int = 0  # type: ignore[misc]
    """Base steps of a mini-episode in training; 0: those of an option, so that skills soon become
    different."""
    novelty_radius: float = 0.0
    """Distance between features within which a state counts as visited; 0: half of how far an
    action that is repeated moves them, three quarters of how far a skill does."""
    train_base_steps: int = 50_000
    """Base steps of worker training."""
    expansions: int = 20_000
    """Nodes that a search may expand before it gives up, where there is a goal."""
    improve_expansions: int = 2_000
    """Nodes that it expands after the first plan to find a shorter one, where every step costs."""
    search_steps: int = 2_000
    """Base steps that each search may simulate, where rewards are collected."""
    processes: int = 0
    """Processes that simulate; 0: the calling one."""
    keep: str = "last"
    """Which worker of the training to keep: "last"."""
    toy: bool = False
    """A little training and 2 starts, to see in seconds that everything works."""

    EXPERIMENT, KIT = "gym", "gym"
    TOY = {"train_base_steps": 1_280, "mazes": 2, "expansions": 200, "search_steps": 200}
    KEPT = (*SkillsConfig.KEPT, "id", "make", "option_steps", "skill_steps")
    LEAST = {**SkillsConfig.LEAST, "option_steps": 0, "skill_steps": 0, "processes": 0}
    ABOVE_ZERO: ClassVar[tuple[str, ...]] = ("updates_per_step",)
    CHOICES = SkillsConfig.CHOICES | {
        "options": ("learned", "actions", "directions", "goals"),
        "task": ("auto", "goal", "return"),
        "keep": ("last",),
    }

    @property
    def train_steps(self) -> int:  # type: ignore[override]
        """Base steps of training."""
        return max(BATCH_STEPS, self.train_base_steps // BATCH_STEPS * BATCH_STEPS)

    def check_inputs(self) -> None:
        """Check that there is such an env."""
        super().check_inputs()
        if not self.id:
            raise ExperimentError("say which env: env.id=NAME, e.g. env.id=PointMaze_Large-v3.")
        from torchrl_hmcts.envs.gym.settable import make_gym  # here: it loads torch

        try:
            make_gym(self.id, **self.make).close()
        except ValueError as error:
            raise ExperimentError(str(error)) from None


@dataclass
class AntConfig(GymConfig):
    """Keys of ``hmcts train kit=ant env.id=NAME``: the kit ``gym`` where the robot is an ant.

    Its defaults are what was chosen by hand for the ant mazes. Skills are learned by LSD on the
    displacement that a skill brings, without a reward of the env.
    """

    out: str = "runs/ant"
    num_skills: int = 3
    """Skills of the worker; each is taken as it is and after half a turn of the body."""
    option_steps: int = 25  # type: ignore[misc]
    """Actions of an option, of 0.1 seconds; it ends sooner where the ant lies on its back."""
    skill_steps: int = 100  # type: ignore[misc]
    """Actions of a mini-episode in training."""
    novelty_radius: float = 3.0
    """Metres within which a state counts as visited."""
    repeat: int = 0
    """Steps of the env that an action lasts; 0: one in OGBench, and two in gymnasium-robotics,
    whose ant has 20 actions a second."""
    strength: float = 0.0
    """Share of the torques that an action may use; 0: all in OGBench, 0.3 in
    gymnasium-robotics."""
    imagined: float = 0.5
    """Share of replayed transitions that are turned by quarters, with legs renamed, and given to
    another skill."""
    hidden: int = 256
    """Units of each of the two hidden layers of actor and critics."""
    train_base_steps: int = 51_200
    """Actions of worker training."""
    updates_per_step: float = 0.25
    expansions: int = 1_000
    """Nodes that a search may expand before it gives up."""
    leaves_per_wave: int = 8

    EXPERIMENT, KIT = "ant", "ant"
    TOY = {"train_base_steps": 256, "mazes": 2, "expansions": 20, "search_steps": 200}
    KEPT = (*GymConfig.KEPT, "repeat", "strength", "imagined", "hidden")
    LEAST = {**GymConfig.LEAST, "repeat": 0, "strength": 0, "imagined": 0}

    def check_inputs(self) -> None:
        """Check that there is such an env, and that keys are left alone that have no effect."""
        super().check_inputs()
        if self.objective or self.algorithm != "diayn":
            raise ExperimentError(
                f"kit=ant learns by LSD with algorithm=diayn; got objective={self.objective} and "
                f"algorithm={self.algorithm}. Leave both out, or use kit=gym."
            )
