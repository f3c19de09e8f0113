"""Environments: random mazes as TorchRL and Gymnasium environments."""

from __future__ import annotations

from torchrl_hmcts.envs.atari.goals import ByteGoal
from torchrl_hmcts.envs.atari.pool import AtariOptionPool
from torchrl_hmcts.envs.atari.ram import AtariRAMEnv
from torchrl_hmcts.envs.atari.workers import SharedMLP
from torchrl_hmcts.envs.gym.attributes import AttributeSnapshot
from torchrl_hmcts.envs.gym.features import GridFeatures
from torchrl_hmcts.envs.gym.grid_moves import GridMoves, GridView
from torchrl_hmcts.envs.gym.mujoco_batch import MujocoBatch, MujocoTask
from torchrl_hmcts.envs.gym.option_pool import OptionPool
from torchrl_hmcts.envs.gym.option_run import OptionWorker
from torchrl_hmcts.envs.gym.settable import SettableGymEnv
from torchrl_hmcts.envs.gym.skill_worker import PolicyWorker, SkillWorker
from torchrl_hmcts.envs.gym.snapshots import ReplaySnapshot, Snapshot, SnapshotError
from torchrl_hmcts.envs.gym.workers import (
    FeatureGoal,
    FollowGoals,
    JoinedWorkers,
    OccasionalAction,
    RepeatActions,
)
from torchrl_hmcts.envs.gym_envs import TorchRLGymnasiumEnv, register_envs
from torchrl_hmcts.envs.lab.deepmind_lab import DeepMindLabEnv
from torchrl_hmcts.envs.lab.first_person import draw_first_person
from torchrl_hmcts.envs.lab.maze_env import LabMazeEnv
from torchrl_hmcts.envs.lab.mazes import lab_maze
from torchrl_hmcts.envs.lab.states import LAB_ACTIONS
from torchrl_hmcts.envs.mazes.gridworld import GridworldMazeEnv
from torchrl_hmcts.envs.mazes.items import MazeItems
from torchrl_hmcts.envs.mazes.layouts import (
    free_tiles,
    generate_mazes,
    maze_from_text,
    maze_pool,
    maze_to_text,
    shortest_path_lengths,
)
from torchrl_hmcts.envs.mazes.rendering import draw_maze
from torchrl_hmcts.envs.mazes.waterworld import WaterworldMazeEnv
from torchrl_hmcts.envs.stateless import StatelessSimulator

__all__ = [
    "AtariOptionPool",
    "AtariRAMEnv",
    "AttributeSnapshot",
    "ByteGoal",
    "DeepMindLabEnv",
    "FeatureGoal",
    "FollowGoals",
    "GridFeatures",
    "GridMoves",
    "GridView",
    "GridworldMazeEnv",
    "JoinedWorkers",
    "LAB_ACTIONS",
    "LabMazeEnv",
    "MazeItems",
    "MujocoBatch",
    "MujocoTask",
    "OccasionalAction",
    "OptionPool",
    "OptionWorker",
    "PolicyWorker",
    "RepeatActions",
    "ReplaySnapshot",
    "SettableGymEnv",
    "SharedMLP",
    "SkillWorker",
    "Snapshot",
    "SnapshotError",
    "StatelessSimulator",
    "TorchRLGymnasiumEnv",
    "WaterworldMazeEnv",
    "draw_first_person",
    "draw_maze",
    "free_tiles",
    "generate_mazes",
    "lab_maze",
    "maze_from_text",
    "maze_pool",
    "maze_to_text",
    "shortest_path_lengths",
]

register_envs()
