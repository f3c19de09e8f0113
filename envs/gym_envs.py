"""The maze environments as Gymnasium environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Categorical
from torchrl.envs import EnvBase

from torchrl_hmcts.envs.lab.maze_env import LabMazeEnv
from torchrl_hmcts.envs.mazes.gridworld import GridworldMazeEnv
from torchrl_hmcts.envs.mazes.waterworld import WaterworldMazeEnv


class TorchRLGymnasiumEnv(gymnasium.Env):
    """Present a stateless TorchRL env with a discrete action as a ``gymnasium.Env``.

    The observation is the entry ``"observation"``; ``info`` holds the other observation entries as
    numpy arrays (position, target, maze index, ...). ``reset(options={"state": td})`` starts from a
    state.

    Args:
        env (EnvBase): unbatched, with a ``Categorical`` action, ``render(td)`` and an entry
            ``"observation"``.
        render_mode (str, optional): ``"rgb_array"``, or None for no pictures, the default. A window
            is Gymnasium's: ``gymnasium.make(..., render_mode="human")``, or its wrapper
            ``HumanRendering``; it needs pygame, which the extra ``gym`` brings.

    Raises:
        ValueError: if the render mode is another, or the env's action is not one categorical.

    Example:
        >>> from torchrl_hmcts.envs import GridworldMazeEnv, TorchRLGymnasiumEnv
        >>> env = TorchRLGymnasiumEnv(GridworldMazeEnv(), render_mode="rgb_array")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, sorted(info)[:2], env.action_space
        ((66,), ['maze_index', 'player_tile'], Discrete(5))
        >>> observation, reward, terminated, truncated, info = env.step(0)
        >>> env.render().shape
        (304, 304, 3)
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(self, env: EnvBase, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f'render_mode must be None or "rgb_array", got {render_mode!r}.')
        action_spec = env.action_spec
        if not isinstance(action_spec, Categorical) or action_spec.shape or env.batch_size:
            raise ValueError(
                f"TorchRLGymnasiumEnv needs an unbatched env with one Categorical action, got "
                f"batch size {list(env.batch_size)} and {action_spec}. Use e.g. GridworldMazeEnv()."
            )
        self.env = env
        self.render_mode = render_mode
        self.metadata = getattr(env, "metadata", self.metadata)
        self._num_actions = int(action_spec.space.n)
        self.action_space = gymnasium.spaces.Discrete(self._num_actions)
        self.observation_space = _box(env.observation_spec["observation"])
        self._tensordict: TensorDictBase | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see ``gymnasium.Env.reset`` and ``options["state"]`` above."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        state = (options or {}).get("state")
        if state is None:
            self._tensordict = self.env.reset()
        else:
            self._tensordict = self.env.reset(state.copy(), set_state=True)
        return self._shown(self._tensordict)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one step; see ``gymnasium.Env.step``."""
        root = self._current("step")
        if not self.action_space.contains(action):
            raise ValueError(
                f"action must be an integer 0 to {self._num_actions - 1}, got {action!r}."
            )
        root = root.copy().set("action", torch.tensor(int(action), device=self.env.device))
        self._tensordict = td = self.env.step(root)["next"]
        observation, info = self._shown(td)
        return (
            observation,
            td["reward"].item(),
            bool(td["terminated"].item()),
            bool(td["truncated"].item()),
            info,
        )

    def render(self) -> np.ndarray | None:
        """Draw the current state, uint8 ``[h, w, 3]``; None without a mode."""
        td = self._current("render")
        return self.env.render(td) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the TorchRL env."""
        if not self.env.is_closed:
            self.env.close()

    def _current(self, caller: str) -> TensorDictBase:
        if self._tensordict is None:
            raise RuntimeError(
                f"{caller}() needs an episode, and none has begun. Call reset() first."
            )
        return self._tensordict

    def _shown(self, td: TensorDictBase) -> tuple[np.ndarray, dict[str, Any]]:
        # Copies: the env may hand on the same tensor step after step.
        entries = {key: td[key].cpu().numpy().copy() for key in self.env.observation_spec.keys()}
        return entries.pop("observation"), entries


def _box(spec: Any) -> gymnasium.spaces.Box:
    """The Box with exactly the bounds of a TorchRL spec."""
    shape = tuple(spec.shape)
    if isinstance(spec, Bounded):
        low, high = (x.expand(shape).cpu().numpy() for x in (spec.space.low, spec.space.high))
    else:
        low, high = np.full(shape, -np.inf, np.float32), np.full(shape, np.inf, np.float32)
    return gymnasium.spaces.Box(low, high, dtype=low.dtype.type)


def make_maze(name: str, render_mode: str | None = None, **kwargs: Any) -> TorchRLGymnasiumEnv:
    """Make one of the registered envs; keywords go to its class.

    The read-outs of the lab maze are ``"observation"`` and those asked for.
    """
    if name == "LabMaze":
        kwargs["read_outs"] = tuple(dict.fromkeys([*kwargs.get("read_outs", ()), "observation"]))
    return TorchRLGymnasiumEnv(_MAZES[name](**kwargs), render_mode)


make_maze.metadata = TorchRLGymnasiumEnv.metadata  # type: ignore[attr-defined]  # for windows

_MAZES: dict[str, Callable[..., EnvBase]] = {
    "WaterworldMaze": WaterworldMazeEnv,
    "GridworldMaze": GridworldMazeEnv,
    "LabMaze": LabMazeEnv,
}


def register_envs() -> None:
    """Register the maze environments with Gymnasium; a second call does nothing.

    ``import torchrl_hmcts.envs`` does it already. Keywords of ``gymnasium.make`` go to the TorchRL
    env.
    """
    for name in _MAZES:
        env_id = f"torchrl_hmcts/{name}-v0"
        if env_id not in gymnasium.registry:
            # A string, so that the spec can be written to JSON and sent to other processes.
            gymnasium.register(env_id, entry_point=f"{__name__}:make_maze", kwargs={"name": name})
