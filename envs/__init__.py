"""Environments: random mazes as TorchRL and Gymnasium environments."""

from __future__ import annotations

from torchrl_hmcts.arguments import name_all_arguments
from torchrl_hmcts.envs.atari_goals import (
    ByteGoal,
    FollowGoals,
    JoinedWorkers,
    OccasionalAction,
)
from torchrl_hmcts.envs.atari_pool import AtariOptionPool
from torchrl_hmcts.envs.atari_ram import AtariRAMEnv
from torchrl_hmcts.envs.atari_workers import OptionWorker, RepeatActions, SharedMLP
from torchrl_hmcts.envs.deepmind_lab import DeepMindLabEnv
from torchrl_hmcts.envs.gridworld import GridworldMazeEnv
from torchrl_hmcts.envs.gym_envs import TorchRLGymnasiumEnv, register_envs
from torchrl_hmcts.envs.lab_actions import LAB_ACTIONS
from torchrl_hmcts.envs.lab_first_person import draw_first_person
from torchrl_hmcts.envs.lab_maze import LabMazeEnv
from torchrl_hmcts.envs.lab_mazes import lab_maze
from torchrl_hmcts.envs.lab_recordings import replay_recording
from torchrl_hmcts.envs.mazes import (
    check_mazes,
    free_tiles,
    generate_mazes,
    maze_from_text,
    maze_pool,
    maze_to_text,
    shortest_path,
    shortest_path_lengths,
    wall_centers,
)
from torchrl_hmcts.envs.rendering import draw_maze
from torchrl_hmcts.envs.stateless import StatelessSimulator
from torchrl_hmcts.envs.waterworld import WaterworldMazeEnv

__all__ = [
    "AtariOptionPool",
    "AtariRAMEnv",
    "ByteGoal",
    "DeepMindLabEnv",
    "FollowGoals",
    "GridworldMazeEnv",
    "JoinedWorkers",
    "LAB_ACTIONS",
    "LabMazeEnv",
    "OccasionalAction",
    "OptionWorker",
    "RepeatActions",
    "SharedMLP",
    "StatelessSimulator",
    "TorchRLGymnasiumEnv",
    "WaterworldMazeEnv",
    "check_mazes",
    "draw_first_person",
    "draw_maze",
    "free_tiles",
    "generate_mazes",
    "lab_maze",
    "maze_from_text",
    "maze_pool",
    "maze_to_text",
    "register_envs",
    "replay_recording",
    "shortest_path",
    "shortest_path_lengths",
    "wall_centers",
]

name_all_arguments(globals(), __all__)
register_envs()
