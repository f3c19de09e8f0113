"""Recordings of DeepMind Lab's engine, played again in :class:`LabMazeEnv`.

Letters: N steps of a recording.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from torchrl_hmcts.envs.lab.maze_env import LabMazeEnv
from torchrl_hmcts.envs.lab.view import heading_degrees

_REST_HEIGHT = 25.125


def replay_recording(sequence: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Play the actions of a recording in the environment, with the engine's exact clock.

    Args:
        sequence: one recording: ``"rows"`` (text map, the north first), ``"fps"``,
            ``"clock_phase"``, ``"actions"`` (``[N][7]`` as the engine's), and ``"pos"``, ``"rot"``,
            ``"vel_world"``, of which the first row is where it starts. Instead of rows, ``"seed"``
            gives the 9 by 9 maze of that seed.

    Returns:
        What the environment gives, float64: ``"pos"``, ``"rot"`` (pitch, yaw, roll in degrees) and
        ``"vel_world"`` ``[N + 1, 3]``, and ``"reward"`` ``[N]``. After the goal has been met the
        player appears somewhere else than in the recording.

    Raises:
        ValueError: if an entry is missing.

    Example:
        >>> start = {"pos": [[150, 150, 25.125]], "rot": [[0, 0, 0]], "vel_world": [[0, 0, 0]]}
        >>> recording = {"rows": ["****", "*P *", "****"], "fps": 60, "clock_phase": [46, -3]}
        >>> recording |= {**start, "actions": [[0, 0, 0, 1, 0, 0, 0]] * 3}  # forward
        >>> replay_recording(recording)["vel_world"][:, 0].tolist()
        [0.0, 45.0, 89.0, 133.0]
    """
    needed = ("fps", "clock_phase", "actions", "pos", "rot", "vel_world")
    missing = [key for key in needed if key not in sequence]
    if "rows" not in sequence and "seed" not in sequence:
        missing.append("rows")
    if missing:
        raise ValueError(f"replay_recording needs the entries {missing} of the recording.")
    maze = (
        {"mazes": [sequence["rows"]]} if "rows" in sequence else {"maze_seeds": [sequence["seed"]]}
    )
    actions = torch.tensor(np.asarray(sequence["actions"]).reshape(-1, 7), dtype=torch.int64)
    env = LabMazeEnv(
        **_with_spawn(maze),
        actions=None,
        terminate_on_goal=False,
        max_frames=10**12,
        fps=int(sequence["fps"]),
        clock="exact",
        clock_phase=sequence["clock_phase"],
        read_outs=(),
    )
    first = {key: np.asarray(sequence[key][0], np.float64) for key in ("pos", "rot", "vel_world")}
    td = env.make_state(
        0,
        first["pos"][:2].tolist(),
        float(first["rot"][1]),
        velocity=first["vel_world"][:2].tolist(),
    )
    td["turned"][1] = first["rot"][0]
    pos, rot, velocity, reward = [], [], [], []
    for step in range(len(actions) + 1):
        pos.append([*td["position"].tolist(), _REST_HEIGHT])
        velocity.append([*td["velocity"].tolist(), 0.0])
        yaw = heading_degrees(td["turned"][:1].numpy(), td["level"][:1].numpy())
        pitch = heading_degrees(td["turned"][1:].numpy(), np.zeros(1, np.int64))
        rot.append([float(pitch[0]), float(yaw[0]), 0.0])
        if step < len(actions):
            td = env._step(td.set("action", actions[step]))
            reward.append(float(td["reward"]))
    return {
        "pos": np.array(pos),
        "rot": np.array(rot),
        "vel_world": np.array(velocity),
        "reward": np.array(reward),
    }


def _with_spawn(maze: dict[str, Any]) -> dict[str, Any]:
    """The maze, with a spawn point if it has none: the start is given."""
    for rows in maze.get("mazes", ()):
        if not any("P" in row for row in rows):
            text = "\n".join(rows).replace(" ", "P", 1).split("\n")
            return {"mazes": [text]}
    return maze
