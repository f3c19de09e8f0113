"""Snapshots of Gymnasium's classic control envs: a few numbers."""

from __future__ import annotations

import struct
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit

from torchrl_hmcts.envs.gym.snapshots import KNOWN_WRAPPERS, Snapshot, env_layers, time_limits

_ROW = struct.Struct("<6d4q")  # state, its type, its length, the clock, steps after the end
_TYPES = (tuple, np.dtype(np.float64), np.dtype(np.float32))


class ClassicSnapshot(Snapshot):
    """Stores the state and the time limit's clock; no step of these envs draws."""

    width = _ROW.size

    def __init__(self, env: gymnasium.Env) -> None:
        env.reset(seed=0)
        self._own: Any = env.unwrapped
        self._counts = hasattr(self._own, "steps_beyond_terminated")
        self._clocks = time_limits(env)

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        *wrappers, inner = env_layers(env)
        return (
            sum(type(layer) is TimeLimit for layer in wrappers) <= 1
            and all(type(layer) in KNOWN_WRAPPERS for layer in wrappers)
            and type(inner).__module__.startswith("gymnasium.envs.classic_control")
            and hasattr(inner, "state")
        )

    def read(self) -> np.ndarray:
        state = self._own.state
        kind = 0 if type(state) is tuple else 1 if state.dtype == np.float64 else 2
        values = state if kind == 0 else state.tolist()
        beyond = getattr(self._own, "steps_beyond_terminated", None)
        row = bytearray(_ROW.size)
        _ROW.pack_into(
            row,
            0,
            *values,
            *(0.0,) * (6 - len(values)),
            kind,
            len(values),
            (self._clocks[0]._elapsed_steps or 0) if self._clocks else 0,
            -1 if beyond is None else beyond,
        )
        return np.frombuffer(row, np.uint8)

    def restore(self, row: np.ndarray) -> None:
        *numbers, kind, length, steps, beyond = _ROW.unpack(row.tobytes())
        values = tuple(numbers[:length])
        self._own.state = values if kind == 0 else np.array(values, _TYPES[kind])
        if self._counts:
            self._own.steps_beyond_terminated = None if beyond < 0 else beyond
        for clock in self._clocks:
            clock._elapsed_steps = steps
