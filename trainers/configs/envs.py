"""Configs of the environments, group ``env``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from torchrl_hmcts.envs import LAB_ACTIONS
from torchrl_hmcts.trainers.configs.base import EnvComponentConfig


@dataclass
class WaterworldMazeEnvConfig(EnvComponentConfig):
    """Keys of :class:`~torchrl_hmcts.envs.WaterworldMazeEnv`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(WaterworldMazeEnvConfig(batch_size=[8])).batch_size
        torch.Size([8])
    """

    mazes: Any = None
    """Bool [M, H, W], True = wall, equal numbers of walls."""
    max_steps: int = 1000
    """Steps after which an episode is truncated."""
    observation: bool = True
    """Write "observation"; simulators whose worker does not read it save time."""
    batch_size: Any = field(default_factory=list)
    """Copies that reset() without a tensordict makes, and the batch size of the specs."""
    seed: int | None = None
    """Of the env's own generator; drawn from torch's global one by default."""
    device: Any = None
    """Of all tensors; the physics runs on the CPU."""
    _component_: str = "torchrl_hmcts.envs.WaterworldMazeEnv"


@dataclass
class GridworldMazeEnvConfig(EnvComponentConfig):
    """Keys of :class:`~torchrl_hmcts.envs.GridworldMazeEnv`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(GridworldMazeEnvConfig()).batch_size
        torch.Size([])
    """

    mazes: Any = None
    """Bool [M, H, W], True = wall, equal numbers of walls."""
    max_steps: int = 200
    """Steps after which an episode is truncated."""
    observation: bool = True
    """Write "observation"; planners that never read it save time."""
    seed: int | None = None
    """Of the env's own generator; drawn from torch's global one by default."""
    device: Any = None
    """Of all tensors."""
    _component_: str = "torchrl_hmcts.envs.GridworldMazeEnv"


@dataclass
class LabMazeEnvConfig(EnvComponentConfig):
    """Keys of :class:`~torchrl_hmcts.envs.LabMazeEnv`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(LabMazeEnvConfig()).batch_size
        torch.Size([])
    """

    mazes: Any = None
    """Each a sequence of rows of equal length, the north first: * wall, P spawn, G goal, A
    apple."""
    maze_seeds: Any = field(default_factory=lambda: [*range(256)])
    """Seeds of lab_maze."""
    rows: int = 9
    """Cells of these mazes, border included."""
    columns: int = 9
    """Cells of these mazes, border included."""
    num_steps: int = 1
    """Frames per step, all with the same action, as in Lab.step."""
    actions: Any = field(default_factory=lambda: {k: [*v] for k, v in LAB_ACTIONS.items()})
    """Discrete actions by name, each (look right, look down, strafe right, move forward)."""
    terminate_on_goal: bool = True
    """Whether the goal ends the episode."""
    max_frames: int = 10800
    """Of an episode."""
    fps: int = 60
    """Frames per second that the engine is told, 15 to 240."""
    clock: str = "constant"
    """Whether every frame lasts the same, or 1 ms more and sometimes 2 ms less, as the engine's
    do."""
    clock_phase: Any = None
    """Of the exact clock at a reset."""
    friction: float = 6.0
    """Per second, 1 to 60."""
    apple_reward: float = 1.0
    """Reward of an apple; the level's is 1."""
    goal_reward: float = 10.0
    """Reward of the goal; the level's is 10."""
    read_outs: Any = field(
        default_factory=lambda: ["tile_position", "heading", "body_velocity", "goal"]
    )
    """Further observations, any of READ_OUTS: "tile_position" (float32 [*B, 2], position in cells),
    "heading" (cosine and sine), "body_velocity" (forward and left, 1 is top speed), "goal" (in
    cells), "walls_nearby" (float32 [*B, 25], 5 by 5 cells around the player, 1 is wall, north-west
    first), "map" (float32 [*B, R * C], likewise all cells), "apples" (float32 [*B, R * C], 1 where
    one lies) and "observation" (float32 [*B, 8 + 2 * R * C]: the first four, map and apples in a
    row, for agents that read one vector)."""
    batch_size: Any = field(default_factory=list)
    """Copies that reset() without a tensordict makes."""
    seed: int | None = None
    """Of the env's own generator, which draws maze, place and heading."""
    device: Any = None
    """Of all tensors; the simulation runs on the CPU."""
    _component_: str = "torchrl_hmcts.envs.LabMazeEnv"


@dataclass
class AtariRAMEnvConfig(EnvComponentConfig):
    """Keys of :class:`~torchrl_hmcts.envs.AtariRAMEnv`.

    Example:
        >>> AtariRAMEnvConfig(game="Pong").game
        'Pong'
    """

    game: str = MISSING
    """E.g. "Breakout" or "SpaceInvaders"."""
    frame_skip: int = 4
    """Frames per step."""
    repeat_action_probability: float = 0.25
    """Default 0.25, as in Gymnasium and recommended by Machado et al.; 0 is the deterministic
    protocol."""
    full_action_space: bool = False
    """All 18 actions instead of those that the game has."""
    noop_max: int | None = None
    """An episode begins with 1 to noop_max frames of doing nothing; 0 for none."""
    terminal_on_life_loss: bool = False
    """Whether a lost life ends the episode."""
    life_loss_penalty: float = 0.0
    """Taken off the reward for every life lost, e.g. in the env in which is planned."""
    reward_clip: float | None = None
    """Rewards are clipped to [-reward_clip, reward_clip], before the penalty."""
    max_frames: int = 108000
    """Of an episode, then truncated."""
    mode: int | None = None
    """The console's switches."""
    difficulty: int | None = None
    """The console's switches."""
    read_outs: Any = field(default_factory=lambda: ["ram", "observation"])
    """Which of "ram" and "observation" to write."""
    include_state: bool = True
    """Whether "emulator_state" is written."""
    include_rng: bool = False
    """Whether it has the random generator."""
    seed: int | None = None
    """Of starts and sticky actions."""
    device: Any = None
    """Of all tensors; the emulator runs on the CPU."""
    _component_: str = "torchrl_hmcts.envs.AtariRAMEnv"


@dataclass
class StatelessSimulatorConfig(EnvComponentConfig):
    """Keys of :class:`~torchrl_hmcts.envs.StatelessSimulator`.

    Example:
        >>> StatelessSimulatorConfig(state_keys=["state"]).state_keys
        ['state']
    """

    env: Any = MISSING
    """Whose _step depends on nothing but its tensordict."""
    state_keys: Any = None
    """Entries that are the state; those of state_spec and the observation by default."""
    _component_: str = "torchrl_hmcts.envs.StatelessSimulator"
