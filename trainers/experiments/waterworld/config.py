"""Keys of the experiments of chapter 3: the goal-based agent, and A3C without goals."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_hmcts.arguments import name_arguments
from torchrl_hmcts.trainers.runs.config import NUM_TEST_MAZES, RunConfig, check_logger


@name_arguments
@dataclass
class WaterworldA3CConfig(RunConfig):
    """What ``hmcts train experiment=waterworld_a3c`` does; each field is a key.

    Example:
        >>> WaterworldA3CConfig(seed=1).total_frames
        2000000
    """

    out: str = "runs/waterworld_a3c"
    """Folder that receives metrics, curves, pictures, checkpoints and the page; made if absent."""
    total_frames: int = 2_000_000
    """Base steps of training, all learners together (the source's T_max)."""
    num_learners: int = 2
    """Actor-learners, each a process, as many as there are cores; 0: one, in this process."""
    envs_per_learner: int = 32
    """Mazes that a learner plays side by side; 1 is the source's."""
    segment_steps: int = 20
    """Base steps of each maze between two updates (the source's t_max)."""
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
    """Where values go while it trains: "csv" (always), "tensorboard" or "wandb" as well."""
    toy: bool = False
    """Seconds instead of minutes: 4,000 base steps and 3 mazes, to see that everything works."""

    KEPT = (
        "seed",
        "toy",
        "gamma",
        "entropy_coeff",
        "critic_coeff",
        "hidden",
        "max_episode_steps",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (
            "total_frames",
            "envs_per_learner",
            "segment_steps",
            "hidden",
            "max_episode_steps",
            "test_mazes",
            "eval_interval",
            "eval_mazes",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}.")
        if self.num_learners < 0:
            raise ValueError(f"num_learners must not be negative; got {self.num_learners}.")
        for name in ("learning_rate", "clip_norm"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be above 0; got {getattr(self, name)}.")
        for name in ("entropy_coeff", "critic_coeff"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} must not be negative; got {getattr(self, name)}.")
        if not 0.0 < self.gamma <= 1.0:
            raise ValueError(f"gamma must be in (0, 1]; got {self.gamma}.")
        check_logger(self.logger)
        for name in ("test_mazes", "eval_mazes"):
            if getattr(self, name) > NUM_TEST_MAZES:
                raise ValueError(
                    f"{name}={getattr(self, name)}, but the test split has {NUM_TEST_MAZES} mazes."
                )


@name_arguments
@dataclass
class WaterworldGoalsConfig(WaterworldA3CConfig):
    """What ``hmcts train experiment=waterworld_goals`` does; each field is a key.

    Example:
        >>> WaterworldGoalsConfig().goal_divergence_threshold
        2.0
    """

    out: str = "runs/waterworld_goals"
    """Folder that receives metrics, curves, pictures, checkpoints and the page; made if absent."""
    num_goals: int = 3
    """Goals that the worker sees."""
    goal_met_threshold: float = 0.5
    """Tiles within which a goal is met."""
    goal_divergence_threshold: float = 2.0
    """Tiles from the goal beyond which the manager plans anew."""
    r_tick: float = -0.025
    """Worker's reward per base step."""
    r_goal_met: float = 1.0
    """Worker's reward for a goal."""
    r_goal_divergence: float = -1.0
    """Worker's reward when it strays beyond the threshold."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_goals < 1:
            raise ValueError(f"num_goals must be at least 1; got {self.num_goals}.")
        if not 0.0 < self.goal_met_threshold < self.goal_divergence_threshold:
            raise ValueError(
                "A goal must be met closer to it than where the worker has strayed: "
                f"0 < goal_met_threshold < goal_divergence_threshold; got "
                f"{self.goal_met_threshold} and {self.goal_divergence_threshold}."
            )
