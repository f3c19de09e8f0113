"""A stand-in for the module ``deepmind_lab``: its signatures over LabMazeEnv's physics.

It shows that the adapter calls the module as documented and reads what it returns; it shows nothing
about the engine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from torchrl_hmcts.envs import LabMazeEnv
from torchrl_hmcts.envs.lab.states import NATIVE_ACTIONS, heading_degrees

SIZES = {"demos/random_maze": 15, "nine": 9}


class Lab:
    """One level of the engine, one episode at a time."""

    opened: list[Lab] = []

    def __init__(
        self,
        level: str,
        observations: Sequence[str],
        config: Mapping[str, str] | None = None,
        renderer: str = "software",
        level_cache: Any = None,
        temp_folder: str = "",
    ) -> None:
        self.config = {"fps": "60", "width": "320", "height": "240", **(config or {})}
        assert all(isinstance(x, str) for pair in self.config.items() for x in pair)
        assert renderer in ("software", "hardware")
        self._names, self._size = list(observations), SIZES[level]
        known = [spec["name"] for spec in self.observation_spec()]
        for name in self._names:
            if name not in known:
                raise ValueError(f"Unknown observation name: {name}")
        self._env: LabMazeEnv | None = None
        self.steps: list[tuple[list[int], int]] = []
        self.closed = False
        Lab.opened.append(self)

    def observation_spec(self) -> list[dict[str, Any]]:
        height, width = int(self.config["height"]), int(self.config["width"])
        vectors = ("DEBUG.POS.TRANS", "DEBUG.POS.ROT", "VEL.TRANS", "VEL.ROT")
        return [
            {"name": "RGB_INTERLEAVED", "dtype": np.uint8, "shape": (height, width, 3)},
            *({"name": name, "dtype": np.float64, "shape": (3,)} for name in vectors),
            {"name": "INSTR", "dtype": str, "shape": ()},
        ]

    def action_spec(self) -> list[dict[str, Any]]:
        return [
            {"name": name, "min": NATIVE_ACTIONS[name][0], "max": NATIVE_ACTIONS[name][1]}
            for name in NATIVE_ACTIONS
        ]

    def fps(self) -> int:
        return int(self.config["fps"])

    def reset(self, episode: int = -1, seed: int | None = None) -> bool:
        assert seed is not None
        assert isinstance(seed, int)
        seconds = int(self.config.get("episodeLengthSeconds", "180"))
        self._env = LabMazeEnv(
            maze_seeds=[seed],
            rows=self._size,
            columns=self._size,
            actions=None,
            terminate_on_goal=False,
            clock="exact",
            fps=self.fps(),
            max_frames=seconds * self.fps(),
            seed=seed,
        )
        self._td = self._env.reset()
        self._over = False
        return True

    def is_running(self) -> bool:
        return self._env is not None and not self._over

    def step(self, action: np.ndarray, num_steps: int = 1) -> float:
        if not self.is_running():
            raise RuntimeError("Environment in wrong status for call to step()")
        assert isinstance(action, np.ndarray)
        assert action.dtype == np.intc
        assert action.shape == (7,)
        self.steps.append((action.tolist(), num_steps))
        reward = 0.0
        for _ in range(num_steps):
            self._td["action"] = torch.from_numpy(action.astype(np.int64))
            self._td = self._env._step(self._td)
            reward += self._td["reward"].item()
            self._over = bool(self._td["done"])
        return reward

    def observations(self) -> dict[str, np.ndarray]:
        if not self.is_running():
            raise RuntimeError("Environment in wrong status for call to observations()")
        td = self._td
        x, y = td["position"].double().tolist()
        yaw = float(heading_degrees(td["turned"][:1].numpy(), td["level"][:1].numpy())[0])
        forward, left = (td["body_velocity"].double() * 320).tolist()
        height, width = int(self.config["height"]), int(self.config["width"])
        seen = {
            "DEBUG.POS.TRANS": np.array([x, y, 25.125]),
            "DEBUG.POS.ROT": np.array([td["turned"][1].item(), yaw, 0.0]),
            "VEL.TRANS": np.array([forward, left, 0.0]),
            "VEL.ROT": np.zeros(3),
            "RGB_INTERLEAVED": np.full((height, width, 3), 7, np.uint8),
        }
        return {name: seen[name] for name in self._names}

    def close(self) -> None:
        self.closed = True
