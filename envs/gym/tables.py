"""Snapshots of Gymnasium's toy text envs, whose tables never change."""

from __future__ import annotations

import gymnasium

from torchrl_hmcts.envs.gym.snapshots import AttributeSnapshot


class ToyTextSnapshot(AttributeSnapshot):
    """Stores the attributes but the tables of transitions and starts, up to 80 kB."""

    skipped_attributes = AttributeSnapshot.skipped_attributes | {
        "P", "desc", "initial_state_distrib", "locs", "locs_colors",
    }  # fmt: skip

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return type(env.unwrapped).__module__.startswith("gymnasium.envs.toy_text")
