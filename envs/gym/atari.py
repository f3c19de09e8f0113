"""Snapshots of Gymnasium's Atari envs."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from torchrl_hmcts.envs.gym.attributes import AttributeSnapshot
from torchrl_hmcts.envs.gym.snapshots import SnapshotError


class ALESnapshot(AttributeSnapshot):
    """Stores the emulator's own state and the attributes of the env.

    For planning in Atari, :class:`~torchrl_hmcts.envs.AtariRAMEnv` and
    :class:`~torchrl_hmcts.envs.AtariOptionPool` are faster, and exact with sticky actions.

    Args:
        env (gymnasium.Env): of ale-py, with ``repeat_action_probability=0``.
        cap (int): bytes of the attributes at most. Default 65,536.

    Raises:
        SnapshotError: if actions are sticky: the emulator does not tell which one it holds.
    """

    def __init__(self, env: gymnasium.Env, *, cap: int = 1 << 16) -> None:
        import ale_py

        self._ale: Any = env.unwrapped.ale  # type: ignore[attr-defined]
        sticky = self._ale.getFloat("repeat_action_probability")
        if sticky:
            raise SnapshotError(
                f"{env} has sticky actions ({sticky:g}), and ale-py does not tell which action it "
                "holds. Make it with repeat_action_probability=0, or use AtariRAMEnv."
            )
        self._state_type = ale_py.ALEState
        super().__init__(env, cap=cap)
        self._attributes = self.width
        self._room = len(self._serialized()) + 256
        self.width += 8 + self._room

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return type(vars(env.unwrapped).get("ale")).__name__ == "ALEInterface"

    def is_fixed(self, value: Any) -> bool:
        return type(value).__module__.startswith("ale_py") or super().is_fixed(value)

    def read(self) -> np.ndarray:
        row = np.zeros(self.width, np.uint8)
        state = self._serialized()
        row[:8] = np.frombuffer(len(state).to_bytes(8, "little"), np.uint8)
        row[8 : 8 + len(state)] = np.frombuffer(state, np.uint8)
        self._write(row[8 + self._room :])
        return row

    def restore(self, row: np.ndarray) -> None:
        length = int.from_bytes(row[:8].tobytes(), "little")
        self._ale.restoreState(self._state_type(row[8 : 8 + length].tobytes()))
        self._load(row[8 + self._room :])

    def _serialized(self) -> bytes:
        return bytes(self._ale.cloneState(include_rng=True).serialize())
