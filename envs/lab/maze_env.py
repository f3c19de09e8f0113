"""DeepMind Lab's random maze, with the engine's ground movement, as a stateless environment.

Letters: *B batch of the tensordict, n its elements, M mazes, R rows and C columns of cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.base import NO_DEFAULT
from torch import Tensor
from torchrl.data import Bounded, Categorical

from torchrl_hmcts.checks import instance, real_number, whole_number
from torchrl_hmcts.envs.lab.kernels import (
    APPLES,
    CLOCK,
    FRAME,
    LEAD,
    LEVEL_SIZE,
    LOTTERY,
    SPAWN_HEADING,
    advance,
    read_out,
)
from torchrl_hmcts.envs.lab.layout import LabLayout
from torchrl_hmcts.envs.lab.mazes import lab_maze
from torchrl_hmcts.envs.lab.read_outs import PAIRS, READ_OUTS, LabReadOuts
from torchrl_hmcts.envs.lab.states import (
    LAB_ACTIONS,
    NATIVE_ACTIONS,
    STATE,
    TRAILING,
    action_table,
    check_place,
    heading_degrees,
    state_specs,
)
from torchrl_hmcts.envs.mazes.maze_env import MazeEnv
from torchrl_hmcts.envs.mazes.rendering import PLAYER_COLOR, draw_goal, draw_maze, draw_walls

CLOCK_PHASE: Mapping[int, tuple[int, int]] = {
    60: (46, -3),
    30: (42, -5),
    20: (38, -7),
    15: (34, -9),
    120: (48, 20),
}
"""Phase of the engine's clock in the first episode of a process, by frames per second."""


class LabMazeEnv(MazeEnv):
    r"""Walk through DeepMind Lab's random maze: momentum, friction, and a goal far away.

    The level ``demos/random_maze`` with the engine's ground movement, frame by frame: friction,
    acceleration towards the keys' direction, a slide along what is in the way, and a velocity
    rounded to integers. With the velocity :math:`v`, the wanted direction :math:`w` and a frame of
    :math:`\Delta t` seconds, without contact,

    .. math::

        v \leftarrow v\,\Bigl(1 - 6 \Delta t \frac{\max(|v|, 100)}{|v|}\Bigr)_+, \qquad
        v \leftarrow v + w \min\bigl(3200\,\Delta t,\; 320 - v \cdot w\bigr)_+, \qquad
        x \leftarrow x + v\,\Delta t.

    Apples give 1 and the goal 10 by default, in the frame after the one in which they are touched.
    The goal ends the episode (``terminated``), or with ``terminate_on_goal=False``, as in the stock
    level, brings the apples back and the player to another place two frames later. ``truncated``
    after ``max_frames``.

    Stateless and batched: the state is in the tensordict, any batch shape is stepped at once, and
    ``reset(td, set_state=True)`` continues from the state in ``td``. It is a float32 simulation of
    its own, compiled by numba, and needs nothing of DeepMind Lab.

    State: ``"position"`` and ``"velocity"`` (float32 ``[*B, 2]``, x to the east and y to the north,
    world units, 100 to a cell, and units per second), ``"turned"`` (float32 ``[*B, 2]``, degrees of
    yaw and pitch since the spawn), ``"maze_index"`` (int64 ``[*B]``) and ``"level"`` (int64
    ``[*B, 7]``: heading at the spawn, 65,536 to a full turn; apples left, a bit each; whether the
    goal has been met; frame; a random number that draws the next place; phase of the clock, 2).

    Args:
        mazes (sequence of text maps, optional): each a sequence of rows of equal length, the north
            first: ``*`` wall, ``P`` spawn, ``G`` goal, ``A`` apple. Default: those of
            ``maze_seeds``.
        maze_seeds (sequence of int): seeds of :func:`lab_maze`. Default ``range(256)``.
        rows, columns (int): cells of these mazes, border included. Default 9 and 9, the
            dissertation's; the stock level has 15 and 15.
        num_steps (int): frames per step, all with the same action, as in ``Lab.step``. Default 1.
        actions (mapping or None): discrete actions by name, each (look right, look down, strafe
            right, move forward). Default :data:`LAB_ACTIONS`. ``None``: the engine's own, int64
            ``[*B, 7]``: these four, then fire, jump and crouch, which are ignored.
        terminate_on_goal (bool): whether the goal ends the episode. Default True.
        max_frames (int): of an episode. Default 10,800, three minutes.
        fps (int): frames per second of the engine, 15 to 240. Default 60: its frames then
            last 16 ms.
        clock ("constant" or "exact"): whether every frame lasts the same, or 1 ms more and
            sometimes 2 ms less, as the engine's do. Default constant: after a few hundred frames
            the two are a few units apart.
        clock_phase (pair of int, optional): of the exact clock at a reset. Default: that of the
            first episode of an engine's process.
        friction (float): per second, 1 to 60. Default 6, the engine's.
        apple_reward, goal_reward (float): Default 1 and 10, the level's. A planner that stops at
            the first rewarded plan needs ``apple_reward=0`` to look for the goal.
        read_outs (sequence of str): further observations, any of :data:`READ_OUTS`:
            ``"tile_position"`` (float32 ``[*B, 2]``, position in cells), ``"heading"`` (cosine and
            sine), ``"body_velocity"`` (forward and left, 1 is top speed), ``"goal"`` (in cells),
            ``"walls_nearby"`` (float32 ``[*B, 25]``, 5 by 5 cells around the player, 1 is wall,
            north-west first), ``"map"`` (float32 ``[*B, R * C]``, likewise all cells), ``"apples"``
            (float32 ``[*B, R * C]``, 1 where one lies) and ``"observation"`` (float32 ``[*B, 8 + 2
            * R * C]``: the first four, map and apples in a row, for agents that read one vector).
            Default: the first four.
        batch_size (sequence of int): copies that ``reset()`` without a tensordict makes. Any other
            batch shape can be stepped too. Default none.
        seed (int, optional): of the env's own generator, which draws maze, place and heading.
        device (torch.device, optional): of all tensors; the simulation runs on the CPU.

    Raises:
        ValueError: if a maze is unusable, or an argument out of range.

    Reference:
        Beattie et al., "DeepMind Lab", 2016, arXiv 1612.03801; dissertation, section 4.3. Movement
        and mazes agree with recordings of the engine: position to 0.001 units, velocity exactly.

    Example:
        >>> from torchrl_hmcts.envs import LabMazeEnv
        >>> env = LabMazeEnv([["*******", "*P    *", "*    G*", "*******"]], seed=0)
        >>> td = env.make_state(0, position=(150.0, 150.0), heading=0.0)  # facing east
        >>> forward = torch.tensor(list(env.actions).index("forward"))
        >>> frames = 0
        >>> while not td["done"].item():
        ...     td = env.step(td.set("action", forward))["next"]
        ...     frames += 1
        >>> td["reward"].item(), frames
        (10.0, 73)
    """

    TOP_SPEED = 320.0
    """World units per second."""
    CELL = 100.0
    """World units along the side of a cell."""

    make_state_call = "env.make_state(maze_index, position, heading)"
    metadata = {"render_modes": ["rgb_array"], "render_fps": 60}

    def __init__(
        self,
        mazes: Sequence[Sequence[str]] | None = None,
        *,
        maze_seeds: Sequence[int] = range(256),
        rows: int = 9,
        columns: int = 9,
        num_steps: int = 1,
        actions: Mapping[str, Sequence[int]] | None = LAB_ACTIONS,
        terminate_on_goal: bool = True,
        max_frames: int = 10_800,
        fps: int = 60,
        clock: Literal["constant", "exact"] = "constant",
        clock_phase: Sequence[int] | None = None,
        friction: float = 6.0,
        apple_reward: float = 1.0,
        goal_reward: float = 10.0,
        read_outs: Sequence[str] = READ_OUTS[:4],
        batch_size: Sequence[int] = (),
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        name = "LabMazeEnv"
        self.num_steps = whole_number(name, "num_steps", num_steps, least=1)
        self.max_frames = whole_number(name, "max_frames", max_frames, least=1)
        self.fps = int(real_number(name, "fps", fps, least=15, most=240))
        self.friction = real_number(name, "friction", friction, least=1.0, most=60.0)
        self.apple_reward = real_number(name, "apple_reward", apple_reward)
        self.goal_reward = real_number(name, "goal_reward", goal_reward)
        instance(name, "clock", clock, str)
        if clock not in ("constant", "exact"):
            raise ValueError(f'LabMazeEnv has the clocks "constant" and "exact"; got {clock!r}.')
        if clock_phase is None:
            clock_phase = CLOCK_PHASE.get(fps, CLOCK_PHASE[60])
        instance(name, "clock_phase", clock_phase, tuple, list)
        if len(clock_phase) != 2:
            raise ValueError(f"{name} needs two numbers for clock_phase; got {clock_phase}.")
        real_number(name, "clock_phase[0]", clock_phase[0], least=0, most=49)
        real_number(name, "clock_phase[1]", clock_phase[1], least=-100, most=100)
        instance(name, "read_outs", read_outs, tuple, list)
        instance(name, "mazes", mazes, tuple, list, type(None))
        instance(name, "maze_seeds", maze_seeds, Iterable)
        instance(name, "actions", actions, Mapping, type(None))
        if mazes is None:
            mazes = [lab_maze(s, rows, columns) for s in maze_seeds]
        self._start(batch_size, device, terminate_on_goal=terminate_on_goal)
        self.layout = LabLayout(mazes)
        self.num_mazes = len(self.layout)
        self._table = action_table(LAB_ACTIONS if actions is None else actions)
        self.actions = None if actions is None else {k: tuple(v) for k, v in actions.items()}
        self.terminate_on_goal = bool(terminate_on_goal)
        self.frame_msec = int(960 / fps + 0.5)
        """Nominal milliseconds of a frame, in the engine's time."""
        self.exact_clock = clock == "exact"
        self.clock_phase = tuple(int(x) for x in clock_phase)
        self._read = LabReadOuts(self.layout, read_outs)
        if self.actions is not None:
            action: Any = Categorical(len(self.actions), shape=(), device=self.device)
        else:
            low, high = (torch.tensor(x) for x in zip(*NATIVE_ACTIONS.values(), strict=True))
            action = Bounded(low, high, dtype=torch.int64, device=self.device)
        state = state_specs(self.layout, self.max_frames, self.device)
        self._set_up(state, self._read.specs(self.device), action, seed, free=("position",))

    @property
    def read_outs(self) -> tuple[str, ...]:
        """Names of the read-outs that it writes."""
        return self._read.names

    # ---------------------------------------------------------------- stepping

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = tensordict.batch_size
        maze, *state = (_array(tensordict, key, shape) for key in STATE)
        n = len(maze)
        action = tensordict._get_str("action", NO_DEFAULT).numpy(force=True)
        action = np.ascontiguousarray(action, np.int64).reshape(n, 1 if self.actions else 7)
        pairs = np.empty((len(PAIRS), n, 2), np.float32)
        level = np.empty((n, LEVEL_SIZE), np.int64)
        reward = np.empty((n, 1), np.float32)
        ends = np.empty((3, n, 1), np.bool_)
        wrong = advance(
            *state,
            maze,
            action,
            pairs,
            level,
            reward,
            ends,
            self._table,
            self.num_steps,
            self.max_frames,
            self.terminate_on_goal,
            self.frame_msec,
            self.exact_clock,
            self.friction,
            self.apple_reward,
            self.goal_reward,
            *self.layout.tables,
        )
        if wrong >= 0:
            self._refuse(wrong, maze, state, action)
        return self._write(pairs, level, maze, shape, reward, ends)

    def _refuse(
        self, i: int, maze: np.ndarray, state: Sequence[np.ndarray], action: np.ndarray
    ) -> None:
        """Raise ValueError for an element that cannot be stepped."""
        position, velocity, *_ = state
        actions = "the engine's seven" if self.actions is None else f"0 to {len(self.actions) - 1}"
        raise ValueError(
            f"LabMazeEnv cannot step element {i}: action {action[i].squeeze().tolist()} (allowed: "
            f"{actions}), maze_index {maze[i]} (0 to {self.num_mazes - 1}), position "
            f"{position[i].tolist()} (inside {self.layout.columns} x {self.layout.rows} cells of "
            f"{self.CELL:g}), velocity {velocity[i].tolist()} (finite). One of them is out of "
            f"range; find what wrote it."
        )

    def _write(
        self,
        pairs: np.ndarray,  # float32 [7, n, 2]
        level: np.ndarray,  # int64 [n, 7]
        maze: np.ndarray,  # int64 [n]
        shape: torch.Size,
        reward: np.ndarray | None = None,
        ends: np.ndarray | None = None,
    ) -> TensorDict:
        """The tensordict of a state, with its read-outs."""
        # Few calls: an entry of its own array would cost two microseconds.
        each = torch.from_numpy(pairs).reshape((len(PAIRS), *shape, 2)).unbind(0)
        tensors = {
            "maze_index": torch.from_numpy(maze).reshape(shape),
            "position": each[0],
            "velocity": each[1],
            "turned": each[2],
            "level": torch.from_numpy(level).reshape((*shape, LEVEL_SIZE)),
            **self._read.from_pairs(each),
        }
        for key, array in self._read.others(pairs, level, maze).items():
            tensors[key] = torch.from_numpy(array).reshape((*shape, -1))
        if reward is not None and ends is not None:
            tensors["reward"] = torch.from_numpy(reward).reshape((*shape, 1))
            flags = torch.from_numpy(ends).reshape((3, *shape, 1)).unbind(0)
            tensors["terminated"], tensors["truncated"], tensors["done"] = flags
        if self.device is not None and self.device.type != "cpu":
            tensors = {key: tensor.to(self.device) for key, tensor in tensors.items()}
        return self._pack(tensors, shape)

    def _write_state(self, state: Sequence[np.ndarray], shape: torch.Size) -> TensorDict:
        """The tensordict of a state ``[n, ...]``, in the order of ``STATE``."""
        maze, position, velocity, turned, level = state
        pairs = np.empty((len(PAIRS), len(maze), 2), np.float32)
        pairs[0], pairs[1], pairs[2] = position, velocity, turned
        read_out(pairs, level, maze, self.layout.goal)
        return self._write(pairs, level, maze, shape)

    # ---------------------------------------------------------------- resets

    def _begin(self, shape: torch.Size) -> TensorDict:
        count = shape.numel()

        def draw(high: int) -> np.ndarray:
            return torch.randint(high, (count,), generator=self._generator).numpy()

        maze = draw(self.num_mazes)
        share = torch.rand(count, generator=self._generator, dtype=torch.float64).numpy()
        spawn = (share * self.layout.num_spawns[maze]).astype(np.int64)
        position = self.layout.spawn[maze, spawn]
        return self._write_state(self._fresh(maze, position, draw(65536), draw(2**32)), shape)

    def _fresh(
        self, maze: np.ndarray, position: np.ndarray, heading: np.ndarray, lottery: np.ndarray
    ) -> list[np.ndarray]:
        """The state at rest at the beginning of an episode, in the order of ``STATE``."""
        level = np.zeros((len(maze), LEVEL_SIZE), np.int64)
        level[:, SPAWN_HEADING] = heading
        level[:, APPLES] = (1 << self.layout.num_apples[maze]) - 1
        level[:, LOTTERY] = lottery
        level[:, CLOCK], level[:, LEAD] = self.clock_phase
        at_rest = np.zeros((len(maze), 2), np.float32)
        return [maze.astype(np.int64), position.astype(np.float32), at_rest, at_rest.copy(), level]

    def _reset_to_state(self, tensordict: TensorDictBase | None) -> TensorDict:
        maze, position, *_ = self._state_of(tensordict)
        assert tensordict is not None
        check_place(self.layout, position, maze)
        return self.read_state(tensordict)

    def make_state(
        self,
        maze_index: Any,
        position: Any,
        heading: Any = 0.0,
        *,
        velocity: Any = (0.0, 0.0),
        frame: Any = 0,
    ) -> TensorDict:
        """Build a state, to step from or to pass to ``reset(td, set_state=True)``.

        Args:
            maze_index (int or Tensor): ``[*B]``, which maze.
            position (sequence or Tensor): ``[*B, 2]``, (x, y) in world units.
            heading (float or Tensor): ``[*B]``, degrees, 0 east and 90 north. Default 0.
            velocity (sequence or Tensor): ``[*B, 2]``, units per second. Default at rest.
            frame (int or Tensor): ``[*B]``, frames already gone. Default 0.

        Returns:
            TensorDict ``[*B]`` as ``env.reset()`` gives it; the arguments are broadcast to ``*B``.

        Raises:
            ValueError: if a value is not finite, out of range or inside a wall.
        """
        place, moving = (torch.as_tensor(x, dtype=torch.float32) for x in (position, velocity))
        maze, gone = (torch.as_tensor(x, dtype=torch.int64) for x in (maze_index, frame))
        degrees = torch.as_tensor(heading, dtype=torch.float64)
        for name, pair in (("position", place), ("velocity", moving)):
            if not pair.ndim or pair.shape[-1] != 2:
                raise ValueError(f"{name} must be (x, y) pairs [*B, 2]; got {list(pair.shape)}.")
        if not torch.isfinite(degrees).all():
            raise ValueError(f"heading must be finite degrees; got {degrees.tolist()}.")
        shape = torch.broadcast_shapes(
            maze.shape, gone.shape, degrees.shape, place.shape[:-1], moving.shape[:-1]
        )
        self._check_form({"maze_index": maze}, maze.shape)
        units = (degrees * (65536 / 360)).round().long() % 65536
        _, at, speed, turned, level = state = self._fresh(
            maze.expand(shape).reshape(-1).numpy(),
            place.expand(*shape, 2).reshape(-1, 2).numpy(),
            units.expand(shape).reshape(-1).numpy(),
            np.zeros(torch.Size(shape).numel(), np.int64),
        )
        speed[:] = moving.expand(*shape, 2).reshape(-1, 2).numpy()
        level[:, FRAME] = gone.expand(shape).reshape(-1).numpy()
        tensors = (
            torch.from_numpy(x.reshape((*shape, *x.shape[1:]))).to(self.device) for x in state
        )
        given = TensorDict(dict(zip(STATE, tensors, strict=True)), shape, device=self.device)
        out = self._reset_to_state(given)
        never = torch.zeros((*shape, 1), dtype=torch.bool, device=self.device)
        return out.update({key: never.clone() for key in self.done_keys})

    def read_state(self, tensordict: TensorDictBase) -> TensorDict:
        """Return a state with its read-outs, e.g. of a state that was observed elsewhere.

        Unlike ``reset(td, set_state=True)`` it does not ask whether the player is clear of walls.

        Args:
            tensordict (TensorDictBase): the state ``[*B]``.

        Returns:
            TensorDict ``[*B]``: the state, and what ``read_outs`` names.
        """
        shape = tensordict.batch_size
        return self._write_state([_array(tensordict, key, shape).copy() for key in STATE], shape)

    # ---------------------------------------------------------------- pictures

    def draw_map(self, axes: Any, tensordict: TensorDictBase) -> None:
        maze = int(tensordict["maze_index"])
        draw_walls(axes, self.layout.walls[maze], north_up=True, scale=self.CELL)
        if self.layout.goal[maze, 0] >= 0:
            draw_goal(axes, self.layout.goal[maze])

    def _draw(self, tensordict: TensorDictBase, options: dict[str, Any]) -> np.ndarray:
        maze, position, _, turned, level = (
            tensordict.get(key).numpy(force=True)[None] for key in STATE
        )
        layout = self.layout
        (degrees,) = heading_degrees(turned[:, 0], level[:, SPAWN_HEADING])
        angle = math.radians(float(degrees))

        def in_picture(points: np.ndarray) -> np.ndarray:
            x, y = (points.astype(np.float64) / self.CELL).T
            return np.stack((x, layout.rows - y), -1)

        player, number = in_picture(position[0]), int(maze[0])
        nose = np.stack((player, player + 0.38 * np.array((math.cos(angle), -math.sin(angle)))))
        apples = int(level[0, APPLES])
        left = [k for k in range(int(layout.num_apples[number])) if apples >> k & 1]
        goal = layout.goal[number]
        options = {"dots": in_picture(layout.apples[number, left]), **options}
        options["paths"] = [*options.get("paths", ()), (nose, PLAYER_COLOR)]
        return draw_maze(
            layout.walls[number],
            player=player.tolist(),
            player_radius=0.15,
            target=in_picture(goal).tolist() if goal[0] >= 0 else None,
            **options,
        )

    def to_picture(self, position: Tensor) -> Tensor:
        """Return positions ``[..., 2]`` in cells of the picture, y to the south."""
        x, y = (position.detach().cpu().double() / self.CELL).unbind(-1)
        return torch.stack((x, self.layout.rows - y), -1)


def _array(td: TensorDictBase, key: str, shape: torch.Size) -> np.ndarray:
    """An entry of the state as ``[n, ...]``, of the type that the compiled movement takes."""
    array = td._get_str(key, NO_DEFAULT).numpy(force=True)  # `get` takes ten times as long
    dtype = np.int64 if key in ("maze_index", "level") else np.float32
    return np.ascontiguousarray(array, dtype).reshape((shape.numel(), *TRAILING[key]))
