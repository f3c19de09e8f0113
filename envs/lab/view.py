"""Headings of DeepMind Lab's player in degrees."""

from __future__ import annotations

import numpy as np


def heading_degrees(turned: np.ndarray, spawn_heading: np.ndarray) -> np.ndarray:
    """Return the heading as the engine reports it, from -180 to 180 in 65,536 steps.

    ``turned`` has the degrees of yaw since the spawn, ``spawn_heading`` has 65,536 to a turn.
    """
    units = np.floor(turned * np.float32(65536.0 / 360.0) + np.float32(0.5)).astype(np.int64)
    units = (units + spawn_heading + 32768) % 65536 - 32768
    return units * (360.0 / 65536.0)
