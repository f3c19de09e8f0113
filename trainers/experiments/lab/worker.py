"""The envs of the ``labmaze`` experiment: for learning skills, planning over them, and acting.

A base step is ``frames_per_step`` frames with the same action.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import count, islice
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from torchrl_hmcts.envs import LabMazeEnv, lab_maze
from torchrl_hmcts.modules import StallTermination
from torchrl_hmcts.objectives import DiscreteSkillSACLoss
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.transforms import (
    DisplacementTransform,
    OptionTransform,
    SkillTransform,
    StallTransform,
)

WORKER_KEYS = ("body_velocity", "heading")
"""What the worker sees besides its skill: how it moves, and where east is."""
PLACE_KEY = "tile_position"
"""Where the player is, in cells: what the displacement and the novelty of a place are about."""
STALL_SPEED = 0.3
"""Share of the top speed below which a player is at a standstill."""
TRAINING_MAZES = 256
"""Seeds 0 to 255 are those of the mazes that skills are learned in."""
TEST_SEED, CURVE_SEED = 1_000_000, 2_000_000
"""First seeds of the test mazes, and of the mazes that Figure 4.10's curve is drawn from."""


def make_lab_env(maze_seeds: Sequence[int] = range(TRAINING_MAZES), **kwargs: Any) -> LabMazeEnv:
    """Build the maze as the experiment plays it: only the goal is rewarded, and ends the episode.

    Args:
        maze_seeds: of the mazes.
        **kwargs: of :class:`~torchrl_hmcts.envs.LabMazeEnv`, e.g. ``rows``, ``fps``, ``friction``.

    Example:
        >>> env = make_lab_env([1])
        >>> env.num_steps, env.apple_reward, env.goal_reward
        (4, 0.0, 1.0)
    """
    settings: dict[str, Any] = {
        "num_steps": 4,
        "apple_reward": 0.0,  # a search ends with the first reward, which is to be the goal's
        "goal_reward": 1.0,
        "read_outs": (PLACE_KEY, *WORKER_KEYS),
    }
    return LabMazeEnv(maze_seeds=maze_seeds, **{**settings, **kwargs})


def make_training_env(
    maze_seeds: Sequence[int] = range(TRAINING_MAZES),
    *,
    num_skills: int = 4,
    skill_steps: int = 50,
    copies: int = 32,
    **kwargs: Any,
) -> TransformedEnv:
    """Build the env in which skills are learned in mini-episodes, with their displacement in cells.

    Args:
        maze_seeds: of the mazes.
        num_skills: number of skills.
        skill_steps: base steps of a mini-episode.
        copies: mazes played at once.
        **kwargs: of the maze.

    Returns:
        The env, of batch size ``[copies]``.

    Example:
        >>> make_training_env([1, 2], copies=2).rollout(3)["next", "displacement"].shape
        torch.Size([2, 3, 2])
    """
    skills = SkillTransform(num_skills, max_skill_steps=skill_steps)
    base = make_lab_env(maze_seeds, batch_size=[copies], **kwargs)
    return TransformedEnv(base, Compose(skills, DisplacementTransform(PLACE_KEY)))


def make_option_env(
    worker: Any,
    maze_seeds: Sequence[int] = range(TRAINING_MAZES),
    *,
    num_skills: int = 4,
    option_steps: int = 25,
    gamma: float = 0.99,
    stall_steps: int = 2,
    trajectory_keys: Sequence[str] | None = None,
    **kwargs: Any,
) -> TransformedEnv:
    """Build a maze whose actions are the worker's skills, for planning and for acting.

    Args:
        worker: reads the ``WORKER_KEYS`` and ``"skill"``, writes ``"action"``.
        maze_seeds: of the mazes.
        num_skills: number of skills, the options.
        option_steps: base steps of an option at most; 25 of 4 frames are the source's 100 frames.
        gamma: discount per base step.
        stall_steps: base steps at a standstill that end an option, see :func:`stall_transform`; 0
            for options of exactly ``option_steps``, as the source's.
        trajectory_keys: base transitions to hand out, see ``OptionTransform``.
        **kwargs: of the maze.

    Returns:
        The macro environment, stateless and without batch size.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> env = make_option_env(worker, [1, 2], stall_steps=0)
        >>> env.rollout(2)["next", "duration"].flatten().tolist()
        [25, 25]
    """
    base = make_lab_env(maze_seeds, **kwargs)
    options = OptionTransform(
        worker,
        num_skills,
        option_steps,
        gamma,
        StallTermination(stall_steps) if stall_steps else None,
        trajectory_keys=trajectory_keys,
    )
    if not stall_steps:
        return TransformedEnv(base, options)
    return TransformedEnv(base, Compose(stall_transform(base), options))


def stall_transform(env: LabMazeEnv) -> StallTransform:
    """Count the base steps in which the player moves at less than 0.3 of the top speed.

    Who pushes against a wall has nothing to gain from the rest of an option. A start from rest is
    faster than that within 4 frames.

    Args:
        env: whose action repeat and speed count.

    Example:
        >>> round(stall_transform(make_lab_env([1])).tolerance, 2)  # world units
        6.14
    """
    seconds = env.num_steps * env.frame_msec / 1000.0
    return StallTransform("position", tolerance=STALL_SPEED * env.TOP_SPEED * seconds)


def make_worker_loss(num_skills: int = 4, *, seed: int | None = None) -> DiscreteSkillSACLoss:
    """Build actor, critics and discriminator of the worker.

    The actor sees :data:`WORKER_KEYS`, the discriminator the displacement in cells since the skill
    began, the critics both: skills are directions on the map, whatever way the player faces.

    Args:
        num_skills: number of skills.
        seed: of the initial weights.

    Example:
        >>> make_worker_loss(seed=0).actor_network.num_actions
        9
    """
    return DIAYNTrainer.make_loss(
        make_training_env([0], num_skills=num_skills, copies=1),
        num_skills,
        in_keys=WORKER_KEYS,
        critic_keys=(*WORKER_KEYS, "displacement"),
        seed=seed,
    )


def held_out_seeds(num_mazes: int, size: int = 9, *, first: int = TEST_SEED) -> list[int]:
    """Return seeds of mazes none of which is the maze of a training seed, or of another of them.

    Small mazes can come twice, from different seeds; such ones are left out.

    Args:
        num_mazes: how many.
        size: cells of a side, border included.
        first: the first seed that is looked at.

    Example:
        >>> held_out_seeds(3)
        [1000000, 1000001, 1000002]
    """
    known = {lab_maze(seed, size, size) for seed in range(TRAINING_MAZES)}

    def fresh() -> Iterator[int]:
        for seed in count(first):
            maze = lab_maze(seed, size, size)
            if maze not in known:
                known.add(maze)
                yield seed

    return list(islice(fresh(), num_mazes))


def make_starts(env: LabMazeEnv, seed: int) -> TensorDict:
    """Draw one of its spawn points and a heading for each maze of an env.

    Args:
        env: whose mazes are used, one episode each.
        seed: of the draw.

    Returns:
        States ``[M]`` at rest.

    Example:
        >>> make_starts(make_lab_env([1, 2, 3]), seed=0)["maze_index"].tolist()
        [0, 1, 2]
    """
    generator = np.random.default_rng(seed)
    mazes = np.arange(env.num_mazes)
    spawn = (generator.random(len(mazes)) * env.layout.num_spawns).astype(np.int64)
    place = torch.from_numpy(env.layout.spawn[mazes, spawn])
    heading = torch.from_numpy(generator.random(len(mazes)) * 360.0)
    return env.make_state(torch.from_numpy(mazes), place, heading)
