"""Actions of DeepMind Lab's player: the usual discrete ones, and the engine's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from torchrl_hmcts.checks import instance

LAB_ACTIONS: Mapping[str, tuple[int, int, int, int]] = {
    "forward": (0, 0, 0, 1),
    "back": (0, 0, 0, -1),
    "strafe left": (0, 0, -1, 0),
    "strafe right": (0, 0, 1, 0),
    "look left": (-20, 0, 0, 0),
    "look right": (20, 0, 0, 0),
    "forward and look left": (-20, 0, 0, 1),
    "forward and look right": (20, 0, 0, 1),
    "nothing": (0, 0, 0, 0),
}
"""The usual discrete actions: look right, look down (pixels per frame), strafe right, forward."""

NATIVE_ACTIONS: Mapping[str, tuple[int, int]] = {
    "LOOK_LEFT_RIGHT_PIXELS_PER_FRAME": (-512, 512),
    "LOOK_DOWN_UP_PIXELS_PER_FRAME": (-512, 512),
    "STRAFE_LEFT_RIGHT": (-1, 1),
    "MOVE_BACK_FORWARD": (-1, 1),
    "FIRE": (0, 1),
    "JUMP": (0, 1),
    "CROUCH": (0, 1),
}
"""The engine's action: lowest and highest value of each of its seven entries, in its order."""


def action_table(actions: Mapping[str, Sequence[int]]) -> np.ndarray:
    """Return discrete actions as int64 ``[A, 4]``: look right, look down, strafe right, forward."""
    if not actions:
        raise ValueError("At least one action is needed; got none. Leave the default LAB_ACTIONS.")
    bounds = list(NATIVE_ACTIONS.values())[:4]
    for name, action in actions.items():
        instance("LabMazeEnv", f"the action {name!r} of actions", action, Sequence)
        if len(action) != 4 or any(int(x) != x for x in action):
            raise ValueError(
                f"The action {name!r} must be four integers (look right, look down, strafe right, "
                f"move forward); got {tuple(action)}."
            )
        if not all(low <= x <= high for x, (low, high) in zip(action, bounds, strict=True)):
            raise ValueError(
                f"The action {name!r} = {tuple(action)} is out of range: looks are up to 512 "
                f"pixels per frame, strafe and move -1, 0 or 1."
            )
    return np.array(list(actions.values()), np.int64)
