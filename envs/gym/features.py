"""Features: a few numbers of a state that say where it is, for novelty, skills and pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from torchrl_hmcts.envs.gym.grid_features import GridFeatures
from torchrl_hmcts.envs.gym.minigrid import MiniGridSnapshot
from torchrl_hmcts.envs.gym.mujoco import find_physics
from torchrl_hmcts.envs.gym.snapshots import SnapshotError

FEATURES_KEY = "features"
"""Entry of a tensordict that holds the features of a state."""
Features = Callable[[gymnasium.Env, Any], np.ndarray]
"""Gives the features ``[F]`` of an env's state, from the env and its observation."""


def achieved_goal(env: gymnasium.Env, observation: Any) -> np.ndarray:
    """Return what a goal is compared with, float32 ``[F]``."""
    return np.asarray(observation["achieved_goal"], np.float32)


def root_place(env: gymnasium.Env, observation: Any) -> np.ndarray:
    """Return MuJoCo's first two coordinates, the place of a robot, float32 ``[2]``."""
    inner: Any = env.unwrapped
    return inner.data.qpos[:2].astype(np.float32)


def whole_observation(env: gymnasium.Env, observation: Any, *, scale: Any = 1.0) -> np.ndarray:
    """Return the observation, each number times its scale, float32 ``[F]``; int64 without one."""
    parts = observation.values() if isinstance(observation, dict) else [observation]
    flat = [np.asarray(part).reshape(-1) for part in parts]
    whole = flat[0] if len(flat) == 1 else np.concatenate(flat)
    if scale is None:
        return whole.astype(np.int64)
    return whole.astype(np.float32) * np.float32(scale)


def features_of(env: gymnasium.Env) -> Features:
    """Return the features that suit an env.

    They are the achieved goal of an env with goals; :class:`GridFeatures` in MiniGrid; the place of
    the robot in MuJoCo; and else the observation.
    """
    space = env.observation_space
    if isinstance(space, spaces.Dict) and "achieved_goal" in space.spaces:
        return achieved_goal
    if MiniGridSnapshot.fits(env):
        turns = env.has_wrapper_attr("moves") and env.get_wrapper_attr("moves")  # of a GridView
        return GridFeatures(directed=not turns)
    try:
        model, _ = find_physics(env)
    except SnapshotError:
        return whole_observation
    free = int(model.jnt_type[0]) == 0 or list(model.jnt_type[:2]) == [2, 2]
    return root_place if free and hasattr(env.unwrapped, "data") else whole_observation


class WithFeatures(gymnasium.ObservationWrapper):
    """Shows the features beside the observation, e.g. to a vector env of Gymnasium."""

    is_stateless = True

    def __init__(self, env: gymnasium.Env, features: Features) -> None:
        super().__init__(env)
        self.features = features
        first = features(env, env.reset(seed=0)[0])
        own = env.observation_space
        parts = dict(own.spaces) if isinstance(own, spaces.Dict) else {"observation": own}
        low, high = (-np.inf, np.inf) if first.dtype.kind == "f" else (-(2**62), 2**62)
        parts[FEATURES_KEY] = spaces.Box(low, high, first.shape, first.dtype.type)
        self.observation_space = spaces.Dict(parts)

    def observation(self, observation: Any) -> dict[str, Any]:
        """Return the entries of an observation, and the features."""
        shown = observation if isinstance(observation, dict) else {"observation": observation}
        return {**shown, FEATURES_KEY: self.features(self.env, observation)}
