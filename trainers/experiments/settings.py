"""Keys of the experiments on mazes. Nothing heavy is imported, so that they are listed at once."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from torchrl_hmcts.trainers.runs.config import RunConfig, need_package

NUM_TEST_MAZES = 342  # of Waterworld's test split
BATCH_STEPS = 64  # base steps of a batch of DIAYN's training


@dataclass
class SkillsConfig(RunConfig):
    """Keys of the whole agent over any kit: skills, plans over them, and their execution.

    ``objective``, ``loss``, ``trainer`` and ``planner`` hold what differs from the kit's own: by
    keyword, with ``"_component_"`` the path of a class where another one is chosen.

    Raises:
        ValueError: if a value is out of its range or does not fit the others.

    Example:
        >>> SkillsConfig(planner={"waves_in_flight": 2}).planner
        {'waves_in_flight': 2}
    """

    mazes: int = 100
    """Test mazes to solve, none of which the worker has been trained in."""
    options: str = "learned"
    """"learned": the manager plans over skills; "actions": over primitive actions, each repeated,
    without any training."""
    worker: str = ""
    """Folder of a run or an agent whose skills are taken; none are learned then."""
    algorithm: str = "diayn"
    """Training of the worker: "diayn" (mini-episodes, before the manager plans) or "hmcts"
    (Algorithm 3 from scratch: rounds of search in training mazes)."""
    objective: dict[str, Any] = field(default_factory=dict)
    """Objective of the skills: objective=metra, lsd, dads or diayn, the default;
    objective.KEY=VALUE."""
    objective_key: str = ""
    """Entry of the state that the objective reads. Default: the displacement since the skill began
    (DIAYN) or the place; "observation": all that the env shows, and no feature made by hand."""
    loss: dict[str, Any] = field(default_factory=dict)
    """The worker's loss: loss=diayn, the default, or discrete_skill_sac; for actions within bounds
    skill_sac. Its keywords: loss.KEY=VALUE, e.g. loss.alpha_init=0.1."""
    trainer: dict[str, Any] = field(default_factory=dict)
    """Keywords of the trainer: trainer.KEY=VALUE, e.g. trainer.buffer_size=50000."""
    planner: dict[str, Any] = field(default_factory=dict)
    """Parts of the planner: planner/PART=NAME, e.g. planner/tree_policy=puct, and their keywords:
    planner.KEY=VALUE, planner.PART.KEY=VALUE. They hold for Algorithm 3's training rounds too, but
    the expansions of those are round_expansions."""
    manager: str = "novelty"
    """Manager: "novelty" (UCT with a novelty test), "four_stages" (the dissertation's: UCT with a
    random simulation from each new node, no novelty test), or "learned" (prior and value, learned
    from searches in training mazes, guide the search in test mazes)."""
    manager_searches: int = 400
    """Training searches in each of the four iterations of manager=learned."""
    num_skills: int = 4
    """Skills of the worker, the options of the manager (the dissertation's N_policies)."""
    updates_per_step: float = 3 / 64
    """Updates of the networks per base step."""
    init_options: int = 64
    """Options of Algorithm 3 that are drawn uniformly at first (the dissertation's N_init); also
    init_samples."""
    dataset: str = ""
    """Folder of transitions that Algorithm 3 trains on as well (the dissertation's D), as
    replay_buffer.dumps writes it. Default: none."""
    c_p: float = 1.0
    """Constant of UCT in Algorithm 3's rounds."""
    rounds: int = 0
    """Rounds of Algorithm 3; 0: as many as the base steps of training allow."""
    retrain_interval: int = 1
    """Rounds of Algorithm 3 between two trainings of the worker (the dissertation's N_retrain)."""
    round_expansions: int = 30
    """Nodes that the search of a training round may expand: enough for a trained worker to find the
    goal in most rounds."""
    expansions: int = 1_000
    """Nodes that a search in a test maze may expand before it gives up."""
    leaves_per_wave: int = 4
    """Leaves of the tree whose options are simulated together; more are faster, less selective."""
    novelty_radius: float = 1.0
    """Tiles within which a place counts as visited; about what an option covers."""
    features: str = "place"
    """Features that the novelty test compares: "place"; "learned": the output of the objective's
    network, within a radius found from how far options move it; or "none": all states are
    searched."""
    gamma: float = 0.99
    """Discount per base step."""
    curve_mazes: int = 20
    """Mazes, other than the test mazes, in which the worker is tried while it learns."""
    curve_points: int = 0
    """Number of such tests; 0: none (10 with algorithm=hmcts and keep=best)."""
    keep: str = "best"
    """Which worker of a training to keep: "best", that which solved the most of those mazes
    (of several the latest), or "last"."""
    logger: str = "csv"
    """Logger of the training's values: "csv" (always), "tensorboard" or "wandb" as well."""
    collector: str = "local"
    """Collector of the training: "local" acts in this process, "ray" in a process of a
    Ray cluster (with algorithm=diayn; such a run does not continue exactly)."""

    KIT: ClassVar[str] = ""  # name of the kit
    KEPT: ClassVar[tuple[str, ...]] = (
        *("seed", "toy", "options", "worker", "algorithm", "objective", "loss", "trainer"),
        *("objective_key", "planner", "manager", "manager_searches", "num_skills"),
    )
    LEAST = {"curve_points": 0, "rounds": 0}
    ALIASES = {"init_samples": "init_options"}
    ABOVE_ZERO: ClassVar[tuple[str, ...]] = ("novelty_radius", "updates_per_step")
    CHOICES = {
        "options": ("learned", "actions"),
        "algorithm": ("diayn", "hmcts"),
        "manager": ("novelty", "four_stages", "learned"),
        "features": ("place", "learned", "none"),
        "keep": ("best", "last"),
        "collector": ("local", "ray"),
    }

    frames_per_step: ClassVar[int] = 1  # frames that an action of the worker lasts
    max_frames: ClassVar[int] = 1_000  # frames after which an episode ends
    option_steps: ClassVar[int] = 25  # base steps of an option
    skill_steps: ClassVar[int] = 50  # base steps of a mini-episode
    train_steps: ClassVar[int] = 40_000  # base steps of training

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.collector == "ray" and self.algorithm != "diayn":
            raise ValueError(
                f"collector='ray' goes with algorithm='diayn'; got {self.algorithm!r}, whose "
                "searches need the env in this process."
            )

        if self.features == "learned" and self.algorithm == "hmcts":
            raise ValueError(
                "features=learned goes with algorithm='diayn': the rounds of Algorithm 3 search "
                "before there are features. Use features=place."
            )

    def check_inputs(self) -> None:
        """Check what the run needs from outside, before anything is written.

        Raises:
            ModuleNotFoundError: if the package of the logger or of the collector is not installed.
        """
        super().check_inputs()
        if self.collector == "ray":
            need_package("ray")

    @property
    def updates_per_batch(self) -> int:
        """Updates per batch of DIAYN's training."""
        return max(1, round(self.updates_per_step * BATCH_STEPS))


@dataclass
class DemoConfig(SkillsConfig):
    """Keys of ``hmcts demo``: the agent over the kit ``waterworld``.

    Raises:
        ValueError: if a number is out of its range, or ``train_base_steps`` is no multiple of 64.

    Example:
        >>> DemoConfig(seed=3).train_base_steps
        40000
    """

    out: str = "runs/demo"
    mazes: int = 100
    """Test mazes to solve, at most the 342 of the test split."""
    task: str = "maze"
    """Task: "maze" (reach the target), "boat" (the same with a body that must turn
    to where it goes), "apples" (collect what is worth most before the fuel is spent) or "key" (the
    target opens when the key has been taken)."""
    size: int = 9
    """Tiles along a side of the test mazes: 9, 15 or 31. Skills are learned in mazes of 9."""
    search_steps: int = 0
    """Base steps that a search may simulate; 0: no limit (in "apples" 4,000)."""
    option_steps: int = 0  # type: ignore[misc]
    """Base steps of an option (the dissertation's N_worker_samples); 0: 25, for a boat 40."""
    skill_steps: int = 0  # type: ignore[misc]
    """Base steps of a mini-episode in training: long enough that skills become different; 0: 50,
    for a boat 40."""
    train_base_steps: int = 0
    """Base steps of worker training in the training mazes; 0: 40,000, for a boat 80,000."""
    updates_per_step: float = 0.0
    """Updates of the networks per base step; 0: 3/64, for a boat 0.1."""
    toy: bool = False
    """1,920 base steps of training and 3 mazes, to see in seconds that everything works."""

    EXPERIMENT, KIT = "demo", "waterworld"
    KEPT = (*SkillsConfig.KEPT, "skill_steps", "task")
    LEAST = {**SkillsConfig.LEAST, "search_steps": 0}
    CHOICES = {**SkillsConfig.CHOICES, "task": ("maze", "boat", "apples", "key")}
    OWN: ClassVar[Mapping[str, tuple[float, float]]] = {  # of most tasks, of a boat
        "option_steps": (25, 40),
        "skill_steps": (50, 40),
        "train_base_steps": (40_000, 80_000),
        "updates_per_step": (3 / 64, 0.1),
    }

    def __post_init__(self) -> None:
        if self.algorithm == "hmcts" and self.curve_points == 0 and self.keep == "best":
            self.curve_points = 10
        for name, own in self.OWN.items():
            if getattr(self, name) == 0:
                setattr(self, name, own[self.task == "boat"])
        super().__post_init__()
        if self.size not in (9, 15, 31):
            raise ValueError(f"size is 9, 15 or 31 tiles; got {self.size}.")
        if self.train_base_steps % BATCH_STEPS:
            raise ValueError(
                f"train_base_steps={self.train_base_steps} is not a multiple of {BATCH_STEPS}, the "
                "base steps of a batch. Use one."
            )
        if self.mazes > NUM_TEST_MAZES:
            raise ValueError(f"mazes={self.mazes}, but the test split has {NUM_TEST_MAZES} mazes.")

    @property
    def train_steps(self) -> int:  # type: ignore[override]
        """Base steps of training."""
        return self.train_base_steps

    def sized(self) -> DemoConfig:
        """Return the configuration that is run: with ``toy`` a small one."""
        if not self.toy:
            return self
        searches = min(2, self.manager_searches)
        return dataclasses.replace(
            self, train_base_steps=1_920, mazes=min(3, self.mazes), manager_searches=searches
        )


@dataclass
class LabMazeConfig(SkillsConfig):
    """Keys of ``hmcts train experiment=labmaze``: the agent over the kit ``labmaze``.

    A frame is a 60th of a second of the game. A base step of the worker is ``frames_per_step``
    frames with one action.
    """

    out: str = "runs/labmaze"
    task: str = "maze"
    """Task: "maze" (find the goal), "turn" (the same without steps sideways or back)
    or "apples" (collect apples, 1 each, before max_frames are over; the goal pays 1 and ends
    it)."""
    size: int = 9
    """Cells along a side of the test mazes, border included, odd; the stock level has 15."""
    search_frames: int = 0
    """Frames that a search may simulate; 0: no limit."""
    mazes: int = 200
    """Test mazes to solve, all from seeds that were never trained on."""
    option_frames: int = 100
    """Frames of an option at most (the dissertation's N_worker_samples)."""
    stall_steps: int = 2
    """Base steps at a standstill, e.g. at a wall, that end an option in a test maze; 0: none ends
    early, as in the dissertation. A search that finds no plan so is made again without."""
    frames_per_step: int = 4  # type: ignore[misc]
    """Frames that an action of the worker lasts."""
    train_frames: int = 0
    """Frames of worker training at most, simulated ones included, in 256 mazes of 9 x 9; 0: 40,000,
    with task=turn 160,000."""
    updates_per_step: float = 0.1875
    skill_frames: int = 200
    """Frames of a mini-episode in DIAYN's training."""
    max_frames: int = 10_800  # type: ignore[misc]
    """Frames after which an episode ends, three minutes as in the level."""
    expansions: int = 3_000
    """Nodes that a search in a test maze may expand before it gives up."""
    improve_expansions: int = 60
    """Nodes that it expands after the first plan, to find a shorter one."""
    novelty_radius: float = 1.0
    """Cells within which a place counts as visited; less than an option covers."""
    curve_points: int = 10
    """Number of tests of the worker while it learns; 0: none."""
    robust_mazes: int = 40
    """Test mazes to solve where clock and friction differ from the model's, for each sign."""
    robust_error: float = 0.05
    """Share by which they differ."""
    toy: bool = False
    """A little training and 4 mazes, to see in seconds that everything works."""

    EXPERIMENT, KIT = "labmaze", "labmaze"
    TOY = {
        "mazes": 4,
        "train_frames": 4_096,
        "init_options": 8,
        "round_expansions": 1,
        "expansions": 16,
        "improve_expansions": 4,
        "curve_mazes": 2,
        "curve_points": 1,
        "robust_mazes": 2,
        "max_frames": 300,
    }
    KEPT = (
        *(*SkillsConfig.KEPT, "task", "option_frames", "frames_per_step", "updates_per_step"),
        *("skill_frames", "init_options", "retrain_interval", "round_expansions"),
        *("novelty_radius", "gamma"),
    )
    LEAST = {**SkillsConfig.LEAST, "improve_expansions": 0, "stall_steps": 0, "search_frames": 0}
    CHOICES = {**SkillsConfig.CHOICES, "task": ("maze", "turn", "apples")}

    def __post_init__(self) -> None:
        if self.train_frames == 0:
            self.train_frames = 160_000 if self.task == "turn" else 40_000
        super().__post_init__()
        if self.size < 5 or self.size % 2 == 0:
            raise ValueError(f"size must be odd and at least 5 cells; got {self.size}.")
        for name in ("option_frames", "skill_frames"):
            if getattr(self, name) % self.frames_per_step:
                raise ValueError(
                    f"{name}={getattr(self, name)} is not a multiple of "
                    f"frames_per_step={self.frames_per_step}. Use one."
                )
        if not 0.0 <= self.robust_error <= 0.3:
            raise ValueError(f"robust_error must be in [0, 0.3]; got {self.robust_error}.")
        if self.train_steps < 1:
            raise ValueError(
                f"train_frames={self.train_frames} are too few for the first samples and a round "
                f"of algorithm={self.algorithm!r}. Use more, or fewer init_options or "
                f"round_expansions."
            )

    @property
    def option_steps(self) -> int:  # type: ignore[override]
        """Base steps of an option."""
        return self.option_frames // self.frames_per_step

    @property
    def skill_steps(self) -> int:  # type: ignore[override]
        """Base steps of a mini-episode."""
        return self.skill_frames // self.frames_per_step

    @property
    def train_steps(self) -> int:  # type: ignore[override]
        """Base steps after which training ends: its last batch is within ``train_frames``."""
        steps = self.train_frames // self.frames_per_step
        if self.algorithm == "diayn":
            return steps // BATCH_STEPS * BATCH_STEPS
        # Rounds that begin within the limit are finished; a plan is as deep as the search, at most.
        options = self.round_expansions * (self.num_skills + 1)
        batch = self.retrain_interval * options * self.option_steps
        if steps < batch + self.init_options * self.option_steps:
            return 0
        return steps - batch


@dataclass
class WaterworldA3CConfig(RunConfig):
    """Keys of ``hmcts train experiment=waterworld_a3c``."""

    out: str = "runs/waterworld_a3c"
    total_frames: int = 2_000_000
    """Base steps of training, all learners together (the dissertation's T_max)."""
    num_learners: int = 2
    """Actor-learners, each a process, as many as there are cores; 0: one, in this process."""
    envs_per_learner: int = 32
    """Mazes that a learner plays side by side; 1 is the dissertation's."""
    segment_steps: int = 20
    """Base steps of each maze between two updates (the dissertation's t_max)."""
    learning_rate: float = 2e-3
    """Of the shared RMSProp at the start; it falls to 0 in a straight line."""
    gamma: float = 0.99
    """Discount per base step."""
    entropy_coeff: float = 0.01
    """Weight of the entropy bonus."""
    critic_coeff: float = 0.5
    """Weight of the squared value error."""
    clip_norm: float = 10.0
    """Largest norm of a gradient."""
    hidden: int = 128
    """Units of each of the two hidden layers of actor and critic."""
    max_episode_steps: int = 1_000
    """Base steps after which an episode is cut off (50 seconds)."""
    test_mazes: int = NUM_TEST_MAZES
    """Test mazes of the final evaluation, at most the 342 of the test split."""
    eval_interval: int = 100_000
    """Base steps of training between two points of the test curve."""
    eval_mazes: int = 64
    """Test mazes of a point of the curve."""
    logger: str = "csv"
    """Logger of the training's values: "csv" (always), "tensorboard" or "wandb" as well."""
    toy: bool = False
    """Seconds instead of minutes: 4,000 base steps and 3 mazes, to see that everything works."""

    EXPERIMENT = "waterworld_a3c"
    TOY = {
        "total_frames": 4_000,
        "num_learners": 0,
        "test_mazes": 3,
        "eval_mazes": 3,
        "eval_interval": 2_000,
        "max_episode_steps": 100,
    }
    KEPT = (
        *("seed", "toy", "gamma", "entropy_coeff", "critic_coeff", "hidden"),
        "max_episode_steps",
    )
    LEAST = {"num_learners": 0, "entropy_coeff": 0, "critic_coeff": 0}
    ABOVE_ZERO = ("learning_rate", "clip_norm")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("test_mazes", "eval_mazes"):
            if getattr(self, name) > NUM_TEST_MAZES:
                raise ValueError(
                    f"{name}={getattr(self, name)}, but the test split has {NUM_TEST_MAZES} mazes."
                )


@dataclass
class WaterworldGoalsConfig(WaterworldA3CConfig):
    """Keys of ``hmcts train experiment=waterworld_goals``."""

    out: str = "runs/waterworld_goals"
    num_goals: int = 3
    """Goals that the worker sees."""
    goal_met_threshold: float = 0.5
    """Tiles within which a goal is met."""
    goal_divergence_threshold: float = 2.0
    """Tiles from the goal beyond which the manager plans again."""
    r_tick: float = -0.025
    """Worker's reward per base step."""
    r_goal_met: float = 1.0
    """Worker's reward for a goal."""
    r_goal_divergence: float = -1.0
    """Worker's reward when it strays beyond the threshold."""

    EXPERIMENT = "waterworld_goals"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.goal_met_threshold < self.goal_divergence_threshold:
            raise ValueError(
                "A goal counts as met at a smaller distance than that at which the worker counts "
                "as lost: 0 < goal_met_threshold < goal_divergence_threshold; got "
                f"{self.goal_met_threshold} and {self.goal_divergence_threshold}."
            )
