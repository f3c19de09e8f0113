"""Configuration of the ``atari`` experiment."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields, replace

from torchrl_hmcts.trainers.runs.config import ExperimentError, RunConfig, need_package

RULES = ("best", "goals", "actions", "action_sets", "repeat", "screened")
SKILLS = ("diayn", "diayn_displacement", "diayn_controllable", "metra")
_RETRAINED = ("goals_retrained", *(f"{name}_retrained" for name in SKILLS))
NETWORKS = (*SKILLS, *_RETRAINED)


@dataclass
class AtariConfig(RunConfig):
    """Keys of ``hmcts train experiment=atari``.

    A base step is 4 frames of the game. All emulated frames count: real, simulated, and those spent
    on finding options.

    Example:
        >>> AtariConfig(game="Pong").protocol
        'deterministic'
    """

    game: str = "Breakout"
    """The game; needs the extra atari, which brings the games along."""
    out: str = "runs/atari"
    """Folder that receives metrics, curves, pictures, checkpoints and the page; made if absent."""
    protocol: str = "deterministic"
    """"deterministic" (comparable with the dissertation and the planning papers) or "sticky"
    (actions stick with probability 0.25, and the planner is given no random generator)."""
    source: str = "auto"
    """Source of the options; `options=` and `worker=` are the same key. "auto": "screened" for a
    manager that practises, else "best". Rules: "best"
    ("action_sets", "actions" or "goals", with which a planner's trials score best), "goals"
    (found by a probe and trials), "repeat" (one for each action), "actions" (some of these,
    chosen by trials), "action_sets" (all of these, those that fire or those that do not, chosen
    by trials), "screened" (goals found by a probe, and all actions, without any trial).
    Networks: "goals_network" (has learned the goals), "goals_fine_tuned" (that network, trained
    further by SAC on its goals and the game), "diayn" (the dissertation's worker),
    "diayn_displacement", "diayn_controllable" (with other discriminators), "metra".
    With "_retrained" behind its name ("goals_retrained" for "goals_network") a network is
    retrained on what the manager's searches simulate, Algorithm 3."""
    episodes: int = 10
    """Scored episodes, whose mean, least and largest score are the result; none of their starts
    is used to choose anything. A manager that practises plays until the frames are spent, and the
    result is that of the last so many."""
    frames: int = 40_000_000
    """Emulated frames in all, 10 million base steps as in the dissertation, after which no further
    episode begins."""
    max_episode_frames: int = 108_000
    """Real frames after which an episode ends, the community's half an hour."""
    options_from: str = ""
    """Folder of another run of the game, whose options and their length are taken over; what it
    spent on finding them counts."""
    option_steps: int = 0
    """Base steps of an option (the dissertation's N_worker_samples); 0: chosen by trials."""
    tune_trials: int = 4
    """Lengths of options that are tried where `option_steps=0`, of 5, 10, 20, 30."""
    tune_with: str = "grid"
    """"grid" tries the lengths one by one; "optuna" draws lengths and PUCT's c (needs optuna)."""
    num_skills: int = 3
    """Skills of a learned worker (the dissertation's N_policies); 0: those of 3, 4 and 5 with
    which, at the best of 10, 20 and 30 base steps, a trial scores best (its grid search)."""
    skill_base_steps: int = 40_000
    """Base steps of a learned worker's training before the manager plans."""
    rounds: int = 3
    """Rounds of planning and retraining, of `trial_steps` real base steps at `trial_ratio`."""
    game_weight: float = 0.0
    """Weight of the sign of the game's reward in the training of skills before the manager
    plans."""
    fire: float = 0.0
    """Share of a learned skill's steps in which FIRE is taken, where the game has it."""
    curve_every: int = 0
    """Training samples between two points of the learning curve, at which the worker is frozen
    and the agent plays test episodes; 0: no curve."""
    curve_episodes: int = 3
    """Test episodes of such a point."""
    curve_steps: int = 0
    """Base steps after which such an episode is ended; 0: it is played to its end."""
    ratio: float = 25.0
    """Simulated base steps per real one, after which a search selects no new leaves; 0: a reactive
    guide plays without search."""
    rollout_options: int = 5
    """Options of the rollouts that stay in the tree; none where a reactive guide values leaves."""
    tree_policy: str = "puct"
    """"puct" (values scaled to [0, 1]) or "uct", e.g. to compare with."""
    backup: str = "default"
    """"max", "mean" or "default": the max for PUCT, the mean for UCT."""
    guide: str = "auto"
    """Network that learns from the searches and guides those after them: "none", "prior",
    "prior_value", or "reactive", a manager that also practises and can play without search
    (`ratio=0`). It has a say in the episodes in which a bandit expects more of it than of search
    alone. "auto": "reactive" with sticky actions, else "none"."""
    practice: float = 0.5
    """Share of the frames in which a manager that practises does so."""
    c: float = 2.0
    """Weight of exploration; for UCT in units of the greatest reward seen."""
    gamma: float = 0.99
    """Discount per base step."""
    width_novelty: bool = False
    """Prune states without a RAM byte value that is new to the tree (width-1 search)."""
    leaves_per_wave: int = 4
    """Leaves of the tree that are simulated together."""
    waves_in_flight: int = 1
    """Waves of leaves that are simulated at a time; with processes, 2 keep them busy."""
    num_processes: int = -1
    """Processes that emulate; 0: in the command's own; -1: one for each core."""
    trial_steps: int = 1_000
    """Real base steps of a trial in which options are compared."""
    trial_ratio: float = 10.0
    """Simulated base steps per real one in such a trial."""
    replant_every: int = 100
    """Decisions between checkpoints, at which a new tree begins so that a resumed run continues
    exactly."""
    toy: bool = False
    """A run of seconds, to see that everything works."""

    EXPERIMENT = "atari"
    FREE = ("out", "resume", "overwrite", "episodes", "frames", "options_from", "num_processes")
    PATHS = ("out", "options_from")
    ALIASES = {"options": "source", "worker": "source"}
    CHOICES = {
        "protocol": ("deterministic", "sticky"),
        "source": ("auto", *RULES, "goals_network", "goals_fine_tuned", *NETWORKS),
        "tune_with": ("grid", "optuna"),
        "tree_policy": ("puct", "uct"),
        "backup": ("default", "max", "mean"),
        "guide": ("auto", "none", "prior", "prior_value", "reactive"),
    }  # fmt: skip
    LEAST = {
        "option_steps": 0, "rollout_options": 0, "num_processes": -1, "num_skills": 0,
        "curve_every": 0, "curve_steps": 0,
    }  # fmt: skip
    ABOVE_ZERO = ("c", "trial_ratio")
    TOY = {
        "frames": 20_000,
        "max_episode_frames": 2_000,
        "source": "repeat",
        "option_steps": 10,
        "ratio": 5.0,
        "skill_base_steps": 512,
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.ratio >= 0.0 or (self.ratio == 0.0 and self._guide != "reactive"):
            raise ValueError(
                f"ratio must be above 0; got {self.ratio}. With guide=reactive ratio=0 plays "
                f"without search; here it is guide={self.guide}."
            )
        if not 0.0 <= self.practice < 1.0:
            raise ValueError(
                f"practice is a share of the frames, 0 to below 1; got {self.practice}."
            )

    @property
    def KEPT(self) -> tuple[str, ...]:  # type: ignore[override]  # noqa: N802
        """Keys that a run keeps when it is resumed: all but those that may change on the way."""
        return tuple(field.name for field in fields(self) if field.name not in self.FREE)

    @property
    def _guide(self) -> str:
        auto = "reactive" if self.protocol == "sticky" else "none"
        return auto if self.guide == "auto" else self.guide

    def resolved(self) -> AtariConfig:
        """Return the configuration with what "auto" stands for."""
        guide = self._guide
        source = self.source
        if source == "auto":
            source = "screened" if guide == "reactive" else "best"
        return replace(self, guide=guide, source=source)

    def check_inputs(self) -> None:
        """Check what the run needs from outside, before anything is written.

        Raises:
            ModuleNotFoundError: if the emulator or optuna is needed and not installed.
            ExperimentError: if there is no such game, or no run of it in ``options_from``.
        """
        super().check_inputs()
        if not 0.0 <= self.fire < 1.0:
            raise ExperimentError(f"fire is a share of steps, 0 to below 1; got {self.fire}.")
        need_package("ale_py")
        if self.tune_with == "optuna":
            need_package("optuna")
        from torchrl_hmcts.envs.atari.emulator import find_game

        try:
            find_game(self.game)
        except ValueError as error:
            raise ExperimentError(str(error)) from None
        if self.options_from and not os.path.isdir(os.path.join(self.options_from, "checkpoints")):
            raise ExperimentError(
                f"options_from={self.options_from} is not a run of this experiment: it has no "
                "folder checkpoints. Name a folder that hmcts train experiment=atari wrote."
            )
