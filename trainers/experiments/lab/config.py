"""Configuration of the ``labmaze`` experiment."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_hmcts.arguments import name_arguments
from torchrl_hmcts.trainers.runs.config import RunConfig, check_logger, need_package

_ALGORITHMS = ("diayn", "hmcts")
_COLLECTORS = ("local", "ray")
_KEEP = ("best", "last")
BATCH_STEPS = 64  # base steps of a batch of DIAYN's training


@name_arguments
@dataclass
class LabMazeConfig(RunConfig):
    """What ``hmcts train experiment=labmaze`` does.

    A frame is a 60th of a second of the game. A base step of the worker is ``frames_per_step``
    frames with one action.

    Example:
        >>> LabMazeConfig(seed=3).option_steps
        25
    """

    out: str = "runs/labmaze"
    """Folder that receives metrics, pictures, checkpoints and the page; made if absent."""
    algorithm: str = "diayn"
    """How the worker learns: "diayn" (mini-episodes, before the manager plans) or "hmcts"
    (Algorithm 3 from scratch: rounds of search in training mazes)."""
    size: int = 9
    """Cells along a side of the test mazes, border included, odd; the stock level has 15."""
    mazes: int = 200
    """Test mazes to solve, all from seeds that were never trained on."""
    num_skills: int = 4
    """Skills of the worker, the options of the manager (the source's N_policies)."""
    option_frames: int = 100
    """Frames of an option at most (the source's N_worker_samples)."""
    stall_steps: int = 2
    """Base steps at a standstill, e.g. at a wall, that end an option in a test maze; 0: none ends
    early, as in the source. A search that finds no plan so is made again without."""
    frames_per_step: int = 4
    """Frames that an action of the worker lasts."""
    train_frames: int = 40_000
    """Frames of worker training at most, simulated ones included, in 256 mazes of 9 x 9."""
    updates_per_step: float = 0.1875
    """Updates of the networks per base step."""
    skill_frames: int = 200
    """Frames of a mini-episode in DIAYN's training."""
    init_options: int = 64
    """Options of Algorithm 3 that are drawn uniformly at first (the source's N_init)."""
    retrain_interval: int = 4
    """Rounds of Algorithm 3 between two trainings of the worker (the source's N_retrain)."""
    round_expansions: int = 2
    """Nodes that the search of a training round may expand; an untrained worker finds few plans."""
    max_frames: int = 10_800
    """Frames after which an episode ends, three minutes as in the level."""
    expansions: int = 3_000
    """Nodes that a search in a test maze may expand before it gives up."""
    improve_expansions: int = 60
    """Nodes that it expands after the first plan, to find a shorter one."""
    leaves_per_wave: int = 4
    """Leaves of the tree whose options are simulated together; more are faster, less selective."""
    novelty_radius: float = 1.0
    """Cells within which a place counts as visited; less than an option covers."""
    gamma: float = 0.99
    """Discount per base step."""
    curve_mazes: int = 20
    """Held-out mazes, other than the test mazes, in which the worker is tried while it learns."""
    curve_points: int = 10
    """How often it is tried."""
    keep: str = "best"
    """Which worker of DIAYN's training to keep: "best", that which solved the most of those mazes
    (of several the latest), or "last". Algorithm 3 keeps its last."""
    robust_mazes: int = 40
    """Test mazes to solve where clock and friction differ from the model's, for each sign."""
    robust_error: float = 0.05
    """Share by which they differ."""
    logger: str = "csv"
    """Where values go while it trains: "csv" (always), "tensorboard" or "wandb" as well."""
    collector: str = "local"
    """Where the worker acts for its training: "local" in this process, or "ray" in a process of a
    Ray cluster (with algorithm=diayn; a run then does not go on exactly)."""
    toy: bool = False
    """A little training and 3 mazes, to see in seconds that everything works."""

    KEPT = (
        "seed",
        "toy",
        "algorithm",
        "num_skills",
        "option_frames",
        "frames_per_step",
        "updates_per_step",
        "skill_frames",
        "init_options",
        "retrain_interval",
        "round_expansions",
        "novelty_radius",
        "gamma",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (
            "mazes",
            "num_skills",
            "option_frames",
            "frames_per_step",
            "train_frames",
            "skill_frames",
            "init_options",
            "retrain_interval",
            "round_expansions",
            "max_frames",
            "expansions",
            "leaves_per_wave",
            "curve_mazes",
            "curve_points",
            "robust_mazes",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}.")
        if self.algorithm not in _ALGORITHMS:
            raise ValueError(f"algorithm is one of {_ALGORITHMS}; got {self.algorithm!r}.")
        if self.keep not in _KEEP:
            raise ValueError(f"keep is one of {_KEEP}; got {self.keep!r}.")
        check_logger(self.logger)
        if self.collector not in _COLLECTORS:
            raise ValueError(f"collector is one of {_COLLECTORS}; got {self.collector!r}.")
        if self.collector == "ray" and self.algorithm != "diayn":
            raise ValueError(
                f"collector='ray' goes with algorithm='diayn'; got {self.algorithm!r}, whose "
                "searches need the env in this process."
            )
        if self.size < 5 or self.size % 2 == 0:
            raise ValueError(f"size must be odd and at least 5 cells; got {self.size}.")
        for name in ("option_frames", "skill_frames"):
            if getattr(self, name) % self.frames_per_step:
                raise ValueError(
                    f"{name}={getattr(self, name)} is no whole number of base steps of "
                    f"frames_per_step={self.frames_per_step} frames; use a multiple."
                )
        for name in ("improve_expansions", "stall_steps"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must be at least 0; got {getattr(self, name)}.")
        if not self.novelty_radius > 0.0:
            raise ValueError(f"novelty_radius must be above 0 cells; got {self.novelty_radius}.")
        if not self.updates_per_step > 0.0:
            raise ValueError(f"updates_per_step must be above 0; got {self.updates_per_step}.")
        if not 0.0 < self.gamma <= 1.0:
            raise ValueError(f"gamma must be in (0, 1]; got {self.gamma}.")
        if not 0.0 <= self.robust_error <= 0.3:
            raise ValueError(f"robust_error must be in [0, 0.3]; got {self.robust_error}.")
        if self.train_steps < 1:
            raise ValueError(
                f"train_frames={self.train_frames} are too few for the first samples and a round "
                f"of algorithm={self.algorithm!r}. Use more, or fewer init_options or "
                f"round_expansions."
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
    def option_steps(self) -> int:
        """Base steps of an option."""
        return self.option_frames // self.frames_per_step

    @property
    def skill_steps(self) -> int:
        """Base steps of a mini-episode."""
        return self.skill_frames // self.frames_per_step

    @property
    def train_steps(self) -> int:
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
