"""Configs of the trainers, group ``trainer``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from torchrl_hmcts.trainers.configs.base import ComponentConfig


@dataclass
class A3CTrainerConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.trainers.A3CTrainer`.

    Example:
        >>> A3CTrainerConfig(total_frames=1_000).total_frames
        1000
    """

    make_env: Any = MISSING
    """make_env() -> EnvBase of any batch shape, [] or [*B] for copies that each learner plays at
    once."""
    loss_module: Any = MISSING
    """A3CLoss, or any other with an actor_network that trains on segments [*B, T], as TorchRL's
    A2CLoss does."""
    total_frames: int = MISSING
    """Steps of all environments of all learners."""
    segment_steps: int = 20
    """Steps of each environment between two updates."""
    num_learners: int = 2
    """Processes that learn; 0: one, in this process."""
    optimizer: Any = "rmsprop"
    """"rmsprop" (default; SharedRMSprop), "adam" (SharedAdam), optimizer(parameters) -> Optimizer,
    or an optimiser over the loss's parameters; see share_optimizer for the kinds."""
    lr: float = 0.0007
    """Learning rate at the start, of a named optimiser."""
    lr_schedule: Any = "linear"
    """"linear": it falls to 0 at total_frames, as in the paper; "constant"; or factor of the share
    of frames done, 0 to 1."""
    clip_norm: float | None = 0.5
    """Bound of the gradient's norm."""
    configure_learner: Any = None
    """configure_learner(loss_module, i), called in learner i with its own copy, for exploration
    that differs between learners, e.g. lambda loss, i: loss.entropy_coeff.fill_((0.01,
    0.003)[i])."""
    evaluate: Any = None
    """evaluate(policy) -> dict of floats, with a copy of the policy as it is now, without
    gradients."""
    eval_interval: int | None = None
    """Frames between evaluations, besides the one at the end."""
    stop_when: Any = None
    """stop_when(metrics) -> bool, called with what evaluate returned; true ends the run with the
    parameters that were evaluated."""
    logger: Any = None
    """Of TorchRL; gets every value at its T."""
    log_interval: int = 10000
    """Frames between two entries of the log."""
    save_dir: Any = None
    """Folder of the checkpoints, which hold no pickle."""
    save_interval: int | None = None
    """Frames between checkpoints, besides the one at the end."""
    keep_last: int = 2
    """Checkpoints kept."""
    overwrite: bool = False
    """Replace the checkpoints of another run in save_dir; they are removed once this run has
    written one."""
    progress: Any = None
    """Called with total=total_frames it returns a progress bar, e.g. tqdm.tqdm."""
    seed: int = 0
    """Learner i is seeded by (seed, i, T at its start)."""
    start_method: str = "spawn"
    """"spawn" starts each learner as a new interpreter, which takes some seconds; "forkserver"
    imports once for all, and keeps that process for the next run; "fork" is immediate, but unsafe
    once this process has threads."""
    _component_: str = "torchrl_hmcts.trainers.A3CTrainer"


@dataclass
class DIAYNTrainerConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.trainers.DIAYNTrainer`.

    Example:
        >>> DIAYNTrainerConfig(seed=3).seed
        3
    """

    env: Any = MISSING
    """Env under SkillTransform and whatever the objective reads (e.g."""
    loss_module: Any = MISSING
    """A DIAYNLoss, e.g. from make_loss, or any DiscreteSkillSACLoss or SkillSACLoss (continuous
    actions)."""
    total_frames: int = 40000
    """Base steps in all."""
    frames_per_batch: int = 64
    """Base steps per batch, a multiple of the env's copies."""
    updates_per_batch: int = 3
    """Updates per batch."""
    batch_size: int = 256
    """Transitions per update."""
    buffer_size: int = 20000
    """Transitions kept."""
    actor_lr: float = 0.002
    """Adam's learning rates."""
    critic_lr: float = 0.003
    """Adam's learning rates."""
    objective_lr: float = 0.01
    """Adam's learning rates."""
    alpha_lr: float = 0.01
    """Learning rate of log alpha, when it is tuned."""
    target_tau: float = 0.05
    """Share of the critics moved into their targets per update."""
    clip_norm: float = 10.0
    """Bound of the gradient's norm, over all parameters."""
    reward: Any = None
    """Replay buffer transform that writes the reward."""
    coverage: Any = None
    """What counts as visited."""
    progress: Any = None
    """Called with total=total_frames it returns a progress bar, e.g. tqdm.tqdm."""
    seed: int | None = None
    """Seeds the env and torch before the first reset."""
    save_dir: Any = None
    """Folder of checkpoints."""
    log_interval: int = 0
    """Base steps between two values that reach the logger."""
    make_collector: Any = "torchrl.collectors._single.Collector"
    """Called as torchrl.collectors.Collector is; it may collect in other processes."""
    _component_: str = "torchrl_hmcts.trainers.DIAYNTrainer"


@dataclass
class HMCTSTrainerConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.trainers.HMCTSTrainer`.

    Example:
        >>> HMCTSTrainerConfig(seed=3).seed
        3
    """

    make_env: Any = MISSING
    """Returns a fresh base env in which plans are carried out, stateless (batch_locked=False), e.g.
    partial(WaterworldMazeEnv, observation=False)."""
    loss_module: Any = MISSING
    """Of the skills, e.g."""
    rounds: int = 200
    """T, with the initial samples, as in the source."""
    num_init_samples: int = 64
    """N_init, options carried out before the first round."""
    retrain_interval: int = 4
    """N_retrain, rounds between two trainings."""
    option_steps: int = 25
    """N_worker_samples, base steps of an option at most."""
    c_p: float = 1.0
    """Constant of UCT."""
    dataset: Any = None
    """D, transitions [n] with the loss's in_keys, e.g. recorded by an OptionRecorder; see
    load_dataset."""
    dataset_fraction: float | None = None
    """Share of each batch that is drawn from D."""
    make_simulator: Any = None
    """As make_env, for the search."""
    make_options: Any = "torchrl_hmcts.transforms.option.OptionTransform"
    """Make_options(worker, num_skills, option_steps, trajectory_keys=...) builds the
    OptionTransform."""
    make_recorder: Any = "torchrl_hmcts.transforms.recorder.OptionRecorder"
    """Make_recorder(keys) builds the two recorders."""
    make_planner: Any = None
    """Make_planner(simulator, tree_policy=UCT(c_p), seed=...) builds the planner, e.g.
    partial(MCTSPlanner, novelty=..., budget=...)."""
    worker: Any = None
    """Carry options out in training and in test rounds."""
    test_worker: Any = None
    """Carry options out in training and in test rounds."""
    make_test_env: Any = None
    """As make_env, with held-out episodes."""
    make_test_planner: Any = None
    """As make_planner."""
    test_rounds: int = 32
    """Episodes of a test, the same in each."""
    test_interval: int = 1
    """Trainings between two tests."""
    updates_per_step: float = 0.046875
    """Updates of a training per base step that S has gained."""
    pretrain_updates: int | None = None
    """Updates on D."""
    batch_size: int = 256
    """Transitions per update."""
    buffer_size: int = 20000
    """Transitions of S that are kept."""
    optimizer: Any = None
    """Default: make_skill_optimizer(loss_module)."""
    reward: Any = None
    """Writes the reward of the sampled transitions."""
    target_tau: float = 0.05
    """Share of the critics moved into their targets per update."""
    clip_norm: float = 10.0
    """Bound of the gradient's norm."""
    total_frames: int | None = None
    """Base steps of S after which no more rounds are played; those of the last retrain_interval
    rounds may go beyond."""
    save_dir: Any = None
    """Folder of the checkpoints, one after every training."""
    keep_last: int = 2
    """Checkpoints kept."""
    progress: Any = None
    """Progress(total=rounds) returns a progress bar, e.g. tqdm.tqdm."""
    seed: int = 0
    """All random numbers of a round or training are a function of it and of t."""
    _component_: str = "torchrl_hmcts.trainers.HMCTSTrainer"
