"""Snapshots of envs whose physics is Box2D, whose world cannot be copied."""

from __future__ import annotations

import gymnasium

from torchrl_hmcts.envs.gym.snapshots import ReplaySnapshot


class Box2DSnapshot(ReplaySnapshot):
    """Replays the episode: no other way of restoring a Box2D world is exact."""

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return any(type(value).__name__ == "b2World" for value in vars(env.unwrapped).values())
