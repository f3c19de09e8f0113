"""The envs of the maze experiments: for learning skills, planning over them, and acting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.transforms import DisplacementTransform, OptionTransform, SkillTransform


def make_training_env(
    mazes: Tensor | None = None,
    *,
    num_skills: int = 4,
    skill_steps: int = 50,
    copies: int = 32,
    max_steps: int = 400,
) -> TransformedEnv:
    """Build the env in which skills are learned in mini-episodes, with their displacement.

    Args:
        mazes: bool ``[M, H, W]``. Default: the training split.
        num_skills: number of skills.
        skill_steps: base steps of a mini-episode.
        copies: mazes played at once.
        max_steps: base steps after which a copy gets a new maze.

    Returns:
        The env, of batch size ``[copies]``.

    Example:
        >>> make_training_env(copies=2).rollout(3)["next", "displacement"].shape
        torch.Size([2, 3, 2])
    """
    base = WaterworldMazeEnv(mazes, observation=False, batch_size=[copies], max_steps=max_steps)
    return TransformedEnv(
        base,
        Compose(SkillTransform(num_skills, max_skill_steps=skill_steps), DisplacementTransform()),
    )


def make_option_env(
    worker: Any,
    mazes: Tensor | None = None,
    *,
    num_skills: int = 4,
    option_steps: int = 25,
    gamma: float = 0.99,
    trajectory_keys: Sequence[str] | None = None,
    seed: int | None = None,
) -> TransformedEnv:
    """Build a Waterworld whose actions are the worker's skills, for planning and for acting.

    Args:
        worker: reads ``"velocity"`` and ``"skill"``, writes ``"action"``.
        mazes: bool ``[M, H, W]``. Default: the training split.
        num_skills: number of skills, the options.
        option_steps: base steps of an option.
        gamma: discount per base step.
        trajectory_keys: base transitions to hand out, see ``OptionTransform``.
        seed: of the env.

    Returns:
        The macro environment, stateless and without batch size.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> make_option_env(worker).rollout(2)["next", "duration"].shape
        torch.Size([2, 1])
    """
    options = OptionTransform(
        worker, num_skills, option_steps, gamma, trajectory_keys=trajectory_keys
    )
    return TransformedEnv(WaterworldMazeEnv(mazes, observation=False, seed=seed), options)
