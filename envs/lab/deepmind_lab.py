"""The real DeepMind Lab engine, with the keys, specs and actions of :class:`LabMazeEnv`.

Letters: R rows and C columns of cells.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from operator import index
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded, UnboundedDiscrete
from torchrl.envs import EnvBase

from torchrl_hmcts.envs.lab.kernels import APPLES, FRAME, GOAL_MET, SPAWN_HEADING
from torchrl_hmcts.envs.lab.maze_env import LabMazeEnv
from torchrl_hmcts.envs.lab.read_outs import READ_OUTS
from torchrl_hmcts.envs.lab.states import LAB_ACTIONS, NATIVE_ACTIONS, action_table

_MODULE = "deepmind_lab"
_NUMBERS = ("uint8", "int32", "int64", "float32", "float64")
_POSITION, _ROTATION, _VELOCITY = "DEBUG.POS.TRANS", "DEBUG.POS.ROT", "VEL.TRANS"
_TYPES = {np.dtype(name): getattr(torch, name) for name in _NUMBERS}


class DeepMindLabEnv(EnvBase):
    """Play the real engine's random maze, with the keys, specs and actions of LabMazeEnv.

    The engine's Python module is not on a package index with an engine inside: build it, see the
    page "DeepMind Lab" of the documentation. Its state cannot be set, so a planner cannot search in
    it; plan in :attr:`model`, a :class:`LabMazeEnv` of the same mazes (made from the same seeds),
    and act here. Every step writes the model's whole state as far as the engine tells it:
    ``"position"`` and ``"velocity"`` exactly, the heading to a 65,536th of a turn, the apples that
    are left by counting rewards, and not the phase of the clock.

    A step with ``num_steps > 1`` is made of single frames, so that it ends in the frame of the goal
    as in LabMazeEnv; the engine is not slower so.

    Args:
        maze_seeds (sequence of int): seeds of the engine's episodes; every reset draws one. Default
            ``range(256)``.
        rows, columns (int): cells of the level's mazes. Default 15 and 15, the stock level's.
        level (str): name of the level, or of a file in the folder ``config["levelDirectory"]``.
            Default the stock random maze.
        config (mapping of str): the engine's settings, e.g. ``{"width": "84", "height": "84"}``.
        observations (mapping of str): further observations of the engine and the keys to write them
            under, e.g. ``{"RGB_INTERLEAVED": "pixels"}``. Default none.
        num_steps, actions, terminate_on_goal, max_frames, fps, read_outs: as of
            :class:`LabMazeEnv`; the engine gets ``fps``.
        renderer ("software" or "hardware"): the engine's. Default software.
        seed (int, optional): of the draws of mazes.

    Raises:
        ImportError: if there is no module ``deepmind_lab``.
        ValueError: if an argument is out of range, or the engine lacks an observation.
        RuntimeError: if the player is seen where the maze of the seed has a wall, or at a reset no
            spawn point; at a step after the end of an episode.

    Reference:
        Beattie et al., "DeepMind Lab", 2016, arXiv 1612.03801; dissertation, section 4.3.

    Example:
        >>> from torchrl_hmcts.envs import DeepMindLabEnv
        >>> try:
        ...     env = DeepMindLabEnv(maze_seeds=[1, 2], num_steps=4)
        ... except ImportError as error:
        ...     print(str(error)[:46])
        DeepMindLabEnv needs the module 'deepmind_lab'
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 60}

    def __init__(
        self,
        *,
        maze_seeds: Sequence[int] = range(256),
        rows: int = 15,
        columns: int = 15,
        level: str = "demos/random_maze",
        config: Mapping[str, str] | None = None,
        observations: Mapping[str, str] | None = None,
        num_steps: int = 1,
        actions: Mapping[str, Sequence[int]] | None = LAB_ACTIONS,
        terminate_on_goal: bool = True,
        max_frames: int = 10_800,
        fps: int = 60,
        read_outs: Sequence[str] = READ_OUTS[:4],
        renderer: Literal["software", "hardware"] = "software",
        seed: int | None = None,
    ) -> None:
        if any(not 0 <= s < 2**31 for s in maze_seeds) or not len(maze_seeds):
            raise ValueError(
                f"DeepMindLabEnv needs maze_seeds, each 0 to 2**31 - 1; got {list(maze_seeds)}."
            )
        try:
            module: Any = importlib.import_module(_MODULE)
        except ImportError as error:
            raise ImportError(
                f"DeepMindLabEnv needs the module {_MODULE!r}, which is not installed ({error}). "
                "No package index has it with the engine inside: build it with Bazel from "
                "https://github.com/google-deepmind/lab (docs/users/build.md there), or with the "
                "tool of the package dmlab-gym (`dmlab-gym build`, needs Docker or Podman). "
                "LabMazeEnv simulates the same level without it."
            ) from error
        super().__init__(batch_size=torch.Size(()))
        self.maze_seeds = tuple(int(s) for s in maze_seeds)
        self.model = LabMazeEnv(
            maze_seeds=self.maze_seeds,
            rows=rows,
            columns=columns,
            num_steps=num_steps,
            actions=actions,
            terminate_on_goal=terminate_on_goal,
            max_frames=max_frames,
            fps=fps,
            read_outs=read_outs,
            seed=0,
        )
        """A simulation of the same mazes, whose state can be set."""
        self.num_steps, self.actions = self.model.num_steps, self.model.actions
        self.max_frames, self.terminate_on_goal = max_frames, bool(terminate_on_goal)
        self._table = action_table(LAB_ACTIONS if self.actions is None else self.actions)
        self._extra = dict(observations or {})
        settings = {"fps": str(fps), **{k: str(v) for k, v in (config or {}).items()}}
        settings.setdefault("episodeLengthSeconds", str(-(-max_frames // fps)))
        names = list(dict.fromkeys([_POSITION, _ROTATION, _VELOCITY, *self._extra]))
        self._lab = module.Lab(level, names, config=settings, renderer=renderer)
        self._is_open = True
        self._set_specs()
        self._running = False
        self.set_seed(
            int(torch.empty((), dtype=torch.int64).random_()) if seed is None else index(seed)
        )

    def _set_specs(self) -> None:
        offered = {str(spec["name"]): spec for spec in self._lab.observation_spec()}
        missing = [n for n in (_POSITION, _ROTATION, _VELOCITY, *self._extra) if n not in offered]
        if missing:
            raise ValueError(
                f"The engine has no observations {missing}; it has {sorted(offered)}. Check the "
                f"names in `observations`, or that the level includes the debug observations."
            )
        model = self.model
        observation = model.observation_spec.clone()
        for name, key in self._extra.items():
            dtype = _TYPES.get(np.dtype(offered[name]["dtype"]))
            shape = tuple(int(n) for n in offered[name]["shape"])
            if key in model.observation_spec.keys() or dtype is None or 0 in shape:
                raise ValueError(
                    f"The observation {name}, of type {offered[name]['dtype']} and shape {shape}, "
                    f"cannot be written under {key!r}: the key must be free, and numbers of a "
                    "fixed shape are needed."
                )
            spec = Unbounded if dtype.is_floating_point else UnboundedDiscrete
            observation[key] = spec(shape, dtype=dtype)
        self.observation_spec = observation
        self.action_spec = model.action_spec.clone()
        self.reward_spec = model.reward_spec.clone()
        self.done_spec = model.done_spec.clone()

    def _set_seed(self, seed: int | None) -> None:
        self._generator = torch.Generator()
        if seed is None:
            self._generator.seed()
        else:
            self._generator.manual_seed(index(seed))

    # ---------------------------------------------------------------- playing

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if kwargs.get("set_state"):
            raise RuntimeError(
                "DeepMindLabEnv cannot be set to a state: the engine has no such call. Plan in "
                "`env.model`, which can, and act in this env; see HierarchicalPolicy."
            )
        draw = torch.randint(len(self.maze_seeds), (), generator=self._generator)
        self._maze = int(draw)
        self._lab.reset(seed=self.maze_seeds[self._maze])
        self._running = True
        self._level = self.model.make_state(
            self._maze, self.model.layout.spawn[self._maze, 0].tolist()
        )["level"]
        seen = self._lab.observations()
        layout, at = self.model.layout, np.asarray(seen[_POSITION], np.float64)[:2]
        if np.abs(layout.spawn[self._maze] - at).max(1).min() > 1.0:
            self._refuse_maze(at)
        return self._state(seen)

    def _refuse_maze(self, at: np.ndarray) -> None:
        layout = self.model.layout
        raise RuntimeError(
            f"The engine's player is at {at.tolist()}, which is a wall, or at a reset no spawn "
            f"point, of the {layout.rows} x {layout.columns} maze of seed "
            f"{self.maze_seeds[self._maze]}: the level's mazes are others. Check rows and columns "
            f"(the stock level has 15 and 15), the level, and that the config sets no mixerSeed."
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self._running:
            raise RuntimeError("The episode has ended, or none has begun. Call reset() first.")
        action = tensordict["action"].numpy(force=True).astype(np.int64)
        native = np.zeros(len(NATIVE_ACTIONS), np.intc)
        if self.actions is None:
            native[:] = action
        elif 0 <= action < len(self._table):
            native[:4] = self._table[action]
        else:
            raise ValueError(f"The action must be 0 to {len(self._table) - 1}; got {action}.")
        level = self._level = self._level.clone()
        reward, won = 0.0, False
        for _ in range(self.num_steps):
            gained = float(self._lab.step(native, num_steps=1))
            reward += gained
            level[FRAME] += 1
            begins_anew, level[GOAL_MET] = bool(level[GOAL_MET]), int(gained >= 10.0)
            if begins_anew:
                level[APPLES] = (1 << int(self.model.layout.num_apples[self._maze])) - 1
            won = gained >= 10.0 and self.terminate_on_goal
            self._running = bool(self._lab.is_running())
            if won or not self._running or level[FRAME] >= self.max_frames:
                break
        over = not self._running or bool(level[FRAME] >= self.max_frames)
        # The engine shows nothing after the end: what it showed last is the last observation.
        seen = self._lab.observations() if self._running else self._seen
        out = self._state(seen, apples=int(reward % 10.0))
        flags = {"terminated": won, "truncated": over, "done": won or over}
        out.update({key: torch.tensor([flag]) for key, flag in flags.items()})
        out.set("reward", torch.tensor([reward]))
        self._running &= not (won or over)
        return out

    def _state(self, seen: Mapping[str, Any], apples: int = 0) -> TensorDict:
        """What the model would have written of the state that the engine shows."""
        self._seen = seen
        at = np.asarray(seen[_POSITION], np.float64)[:2]
        walls = self.model.layout.walls[self._maze]
        column, row = (at // self.model.CELL).astype(np.int64).clip(0, walls.shape[1] - 1)
        if walls[max(0, len(walls) - 1 - row), column]:
            self._refuse_maze(at)
        pitch, yaw = np.asarray(seen[_ROTATION], np.float64)[:2]
        forward, left = np.asarray(seen[_VELOCITY], np.float64)[:2]
        angle = np.radians(yaw)
        velocity = np.rint(
            [
                forward * np.cos(angle) - left * np.sin(angle),
                forward * np.sin(angle) + left * np.cos(angle),
            ]
        )
        self._level[SPAWN_HEADING] = round(yaw * 65536 / 360) % 65536
        self._forget_apples(at, apples)
        state = {
            "maze_index": torch.tensor(self._maze),
            "position": _floats(at),
            "velocity": _floats(velocity),
            "turned": _floats([0.0, pitch]),
            "level": self._level.clone(),
        }
        out = self.model.read_state(TensorDict(state, ()))
        for name, key in self._extra.items():
            out.set(key, torch.from_numpy(np.array(seen[name])))
        return out

    def _forget_apples(self, at: np.ndarray, picked: int) -> None:
        """Take the apples nearest to the player off the list, as many as the rewards say."""
        layout, left = self.model.layout, int(self._level[APPLES])
        for _ in range(picked):
            there = [k for k in range(int(layout.num_apples[self._maze])) if left >> k & 1]
            if there:
                apart = np.abs(layout.apples[self._maze, there] - at).max(1)
                left &= ~(1 << there[int(apart.argmin())])
        self._level[APPLES] = left

    def render(self, tensordict: TensorDictBase, **options: Any) -> np.ndarray:
        """Draw one state from above; see :meth:`LabMazeEnv.render`."""
        return self.model.render(tensordict, **options)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the engine."""
        if self._is_open:
            self._lab.close()
        self._is_open = False
        super().close(raise_if_closed=raise_if_closed)


def _floats(values: Any) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)
