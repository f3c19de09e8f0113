"""Waterworld random maze: thrust a disc with momentum through a random maze to a target.

Letters: *B batch of the tensordict, M mazes, H rows, W columns, K walls per maze.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical

from torchrl_hmcts.checks import instance, real_number
from torchrl_hmcts.envs.mazes.chipmunk import ChipmunkMazes
from torchrl_hmcts.envs.mazes.items import MazeItems, PlacedItems
from torchrl_hmcts.envs.mazes.maze_env import TileMazeEnv
from torchrl_hmcts.envs.mazes.rendering import PLAYER_COLOR, draw_maze

_DIRECTIONS = ((0.0, -1.0), (0.0, 1.0), (-1.0, 0.0), (1.0, 0.0))  # (x, y) of up, down, left, right
_HEADINGS = 32  # of a boat, which turns from one to the next in a base step
_TURNS = (0, -1, 1)  # of ahead, left, right
_OVERLAP_TOLERANCE = 1e-3  # tiles; a disc in contact is up to 2e-5 inside the wall


class WaterworldMazeEnv(TileMazeEnv):
    r"""Steer a disc through a random maze by thrust in four directions until it meets its target.

    The physics is Chipmunk's (pymunk), with collisions that are inelastic and frictionless: the
    speed into a wall is lost, the speed along it is kept. Without contact, with thrust
    :math:`a` and the share :math:`d` of its velocity that the disc keeps per second,

    .. math:: x' = x + v\,\Delta t, \qquad v' = v\,d^{\Delta t} + a\,\Delta t.

    Reward 1 (and ``terminated``) when the disc touches the target, else 0; ``truncated`` at
    ``max_steps``. Stateless and batched: the state is in the tensordict, any batch shape is stepped
    at once, and ``reset(td, set_state=True)`` continues from the state in ``td``; a step depends on
    nothing else.

    Actions: 0 up (towards row 0), 1 down, 2 left, 3 right. State: ``"position"``, ``"velocity"``,
    ``"target"`` (float32 ``[*B, 2]``, (x, y) in tiles and tiles per second, y downwards),
    ``"maze_index"`` (int64 ``[*B]``), ``"step_count"`` (int64 ``[*B, 1]``). Read-out:
    ``"observation"`` (float32 ``[*B, 4 + 2 K]``: player, target, then the centres of the K walls in
    row-major order; 66 numbers for 31 walls).

    Args:
        mazes (Tensor, optional): bool ``[M, H, W]``, True = wall, equal numbers of walls. Default:
            the training split of :func:`~torchrl_hmcts.envs.maze_pool`.
        max_steps (int): steps after which an episode is truncated. Default 1,000, 50 seconds: about
            five times what a good player needs.
        observation (bool): write ``"observation"``; simulators whose worker does not read it save
            time. Default True.
        steering ("directions" or "heading"): with ``"heading"`` the disc is a boat. Its actions are
            0 ahead (thrust where it heads), 1 and 2 turn left and right by 11.25 degrees (no
            thrust); ``"heading"`` (float32 ``[*B, 2]``, a unit vector) joins the state. Default:
            thrust in four directions.
        drag (float): per second; without thrust the velocity falls to ``exp(-drag)`` of it in one.
            Default 2; at least 4/3, so that thrust keeps within :attr:`MAX_SPEED`.
        goal_reward (float): for the target. Default 1.
        items (MazeItems, optional): apples and a key. ``"items"`` (bool ``[*B, K]``, True where one
            lies) joins the state. Default: none.
        batch_size (sequence of int): copies that ``reset()`` without a tensordict makes, and the
            batch size of the specs. Any other batch shape can be stepped too. Default none.
        seed (int, optional): of the env's own generator; drawn from torch's global one by default.
        device (torch.device, optional): of all tensors; the physics runs on the CPU. Default: CPU.

    Raises:
        ValueError: if the mazes are not usable (see :func:`~torchrl_hmcts.envs.check_mazes`) or
            ``max_steps`` is below 1.

    Reference:
        Dissertation, section 3.1.1 and figure 3.1. It gives no physical constants: they are this
        project's, as is the reward.

    Example:
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv, maze_from_text
        >>> maze, _, _ = maze_from_text("..#\n...")
        >>> env = WaterworldMazeEnv(maze[None])
        >>> td = env.make_state(0, position=(0.5, 1.5), target=(2.5, 1.5))
        >>> steps = 0
        >>> while not td["done"].item():
        ...     td = env.step(td.set("action", torch.tensor(3)))["next"]  # thrust to the right
        ...     steps += 1
        >>> td["reward"].item(), steps
        (1.0, 24)
    """

    TIME_STEP = 0.05
    """Seconds per base step."""
    THRUST = 4.0
    """Acceleration of the disc by its thrust, tiles per second squared."""
    DAMPING = math.exp(-2.0)
    """Share of its velocity that the disc keeps in one second without thrust, by default."""
    PLAYER_RADIUS = 0.25
    """Radius of the disc, tiles."""
    TARGET_RADIUS = 0.25
    """Radius of the target, tiles; the episode ends when the two touch."""
    MAX_SPEED = 3.0
    """Largest speed along an axis that a state may have, tiles per second; thrust reaches 2.1. Even
    along a diagonal it moves the disc by less than its radius per step, so none passes a wall."""

    make_state_call = "env.make_state(maze_index, position, target)"
    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(
        self,
        mazes: Tensor | None = None,
        *,
        max_steps: int = 1000,
        observation: bool = True,
        steering: Literal["directions", "heading"] = "directions",
        drag: float = 2.0,
        goal_reward: float = 1.0,
        items: MazeItems | None = None,
        batch_size: Sequence[int] = (),
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(mazes, max_steps, observation, batch_size, device)
        name = "WaterworldMazeEnv"
        self.drag = real_number(name, "drag", drag, least=4 / 3)
        self.goal_reward = real_number(name, "goal_reward", goal_reward)
        if steering not in ("directions", "heading"):
            raise ValueError(
                f'{name} is steered by "directions" or by "heading"; got {steering!r}.'
            )
        self.steering = steering
        instance(name, "items", items, MazeItems, type(None))
        self.items = items
        self._acceleration = np.array(_DIRECTIONS, np.float32) * np.float32(self.THRUST)  # [A, 2]
        angles = np.arange(_HEADINGS) * (2.0 * math.pi / _HEADINGS)
        self._compass = np.stack((np.cos(angles), np.sin(angles)), -1).astype(np.float32)
        self._touch = self.PLAYER_RADIUS + self.TARGET_RADIUS
        self._placed = None if items is None else PlacedItems(items, self.mazes, self._touch)
        self._physics = ChipmunkMazes(
            self.mazes.cpu().numpy(),
            radius=self.PLAYER_RADIUS,
            damping=math.exp(-self.drag),
            time_step=self.TIME_STEP,
        )
        device = self.device
        size = torch.tensor([self.width, self.height], dtype=torch.float32, device=device)
        zero, half = torch.zeros_like(size), torch.full_like(size, 0.5)
        speed = torch.full_like(size, self.MAX_SPEED)
        state = {
            "position": Bounded(zero, size, device=device),
            "velocity": Bounded(-speed, speed, device=device),
            "target": Bounded(zero, size, device=device),
            **self._counted(),
        }
        if steering == "heading":
            state["heading"] = Bounded(-torch.ones_like(size), torch.ones_like(size), device=device)
        if items is not None:
            state["items"] = Binary(items.count, dtype=torch.bool, device=device)
        read_outs: dict[str, Any] = {}
        if self._writes_observation:
            read_outs["observation"] = Bounded(
                torch.cat((zero, zero, half.repeat(self.num_walls))),
                torch.cat((size, size, (size - 0.5).repeat(self.num_walls))),
                device=device,
            )
        num_actions = len(_DIRECTIONS if steering == "directions" else _TURNS)
        action = Categorical(num_actions, shape=(), device=device)
        self._set_up(state, read_outs, action, seed, free=("position", "target"))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        # Small arrays: numpy does in one microsecond what torch does in three.
        target, maze = tensordict.get("target"), tensordict.get("maze_index")
        shape, device = target.shape, target.device
        index = maze.numpy(force=True).reshape(-1)
        thrust, state = self._thrust(tensordict)
        new_position, new_velocity = self._physics.step(
            index,
            tensordict.get("position").numpy(force=True).reshape(-1, 2),
            tensordict.get("velocity").numpy(force=True).reshape(-1, 2),
            thrust,
        )
        offset = new_position - target.numpy(force=True).reshape(-1, 2)
        offset *= offset
        met = offset[:, 0] + offset[:, 1] < self._touch**2
        reward = met.astype(np.float32)
        if self._placed is not None:
            left = tensordict.get("items").numpy(force=True).reshape(len(index), -1)
            state["items"], earned, is_open = self._placed.take(index, new_position, left)
            met &= is_open
            reward = met * np.float32(self.goal_reward) + earned
        elif self.goal_reward != 1.0:
            reward *= np.float32(self.goal_reward)
        terminated = met.reshape(*shape[:-1], 1)
        step_count = tensordict.get("step_count").numpy(force=True) + 1
        truncated = step_count >= self.max_steps
        arrays = {
            "reward": reward.reshape(terminated.shape),
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
            **{key: value.reshape(*shape[:-1], -1) for key, value in state.items()},
        }
        position, velocity, steps, *rest = (
            torch.from_numpy(array).to(device)
            for array in (
                new_position.reshape(shape),
                new_velocity.reshape(shape),
                step_count,
                *arrays.values(),
            )
        )
        entries = dict(zip(arrays, rest, strict=True))
        return self._write_state(
            position, velocity, target, maze, steps, tensordict.batch_size, **entries
        )

    def _thrust(self, tensordict: TensorDictBase) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """The acceleration of each disc, float32 ``[n, 2]``, and where a boat heads afterwards."""
        action = tensordict["action"].numpy(force=True).reshape(-1)
        if self.steering == "directions":
            return self._acceleration[action], {}
        heading = tensordict.get("heading").numpy(force=True).reshape(-1, 2)
        angle = np.arctan2(heading[:, 1], heading[:, 0]) * (_HEADINGS / (2.0 * math.pi))
        index = (np.rint(angle).astype(np.int64) + np.take(_TURNS, action)) % _HEADINGS
        after = self._compass[index]
        return after * ((action == 0) * np.float32(self.THRUST))[:, None], {"heading": after}

    def _write_state(
        self,
        position: Tensor,  # [*B, 2]
        velocity: Tensor,  # [*B, 2]
        target: Tensor,  # [*B, 2]
        maze: Tensor,  # [*B]
        step_count: Tensor,  # [*B, 1]
        batch_size: torch.Size,
        **entries: Tensor,
    ) -> TensorDict:
        entries.update(
            position=position,
            velocity=velocity,
            target=target,
            maze_index=maze,
            step_count=step_count,
        )
        return self._observed(entries, batch_size)

    def _begin(self, shape: torch.Size) -> TensorDict:
        maze, player, target, steps = self._draw_tiles(shape)
        position = self._tile_center(player)
        at_rest = torch.zeros_like(position)
        entries = {}
        if self.steering == "heading":
            drawn = torch.randint(_HEADINGS, shape, generator=self._generator)
            entries["heading"] = torch.from_numpy(self._compass)[drawn].to(position.device)
        if self.items is not None:
            entries["items"] = self._all_items(shape)
        return self._write_state(
            position, at_rest, self._tile_center(target), maze, steps, shape, **entries
        )

    def _all_items(self, shape: torch.Size) -> Tensor:
        assert self.items is not None
        return torch.ones((*shape, self.items.count), dtype=torch.bool, device=self.device)

    def _tile_center(self, tile: Tensor) -> Tensor:
        column_row = torch.stack((tile % self.width, tile // self.width), -1)
        return column_row + 0.5

    def _reset_to_state(self, tensordict: TensorDictBase | None) -> TensorDict:
        position, velocity, target, maze, steps, *others = self._state_of(tensordict)
        assert tensordict is not None
        self._check_places(position, target, maze)
        entries = dict(zip(list(self._limits)[5:], others, strict=True))
        return self._write_state(
            position, velocity, target, maze, steps, tensordict.batch_size, **entries
        )

    def _check_places(self, position: Tensor, target: Tensor, maze: Tensor) -> None:
        size = torch.tensor([self.width, self.height], device=position.device)
        for key, point in (("position", position), ("target", target)):
            if ((point < 0) | (point >= size)).any():
                raise ValueError(
                    f'"{key}" = {point.tolist()} is not inside the maze of {self.width} x '
                    f"{self.height} tiles."
                )
            tile = point.long()
            in_wall = self.mazes[maze, tile[..., 1], tile[..., 0]]
            if in_wall.any():
                raise ValueError(
                    f'"{key}" (x, y) = {point[in_wall][0].tolist()} is inside a wall of maze '
                    f"{int(maze[in_wall][0])}. Choose a free tile, e.g. from "
                    f"free_tiles(env.mazes[{int(maze[in_wall][0])}])."
                )
        # A disc whose centre is close to a face may be pushed out of it on the other side.
        gap = self._distance_to_walls(position, maze)
        bad = gap < self.PLAYER_RADIUS - _OVERLAP_TOLERANCE
        if bad.any():
            raise ValueError(
                f'"position" (x, y) = {position[bad][0].tolist()} is {gap[bad][0].item():.3g} '
                f"tiles from a wall of maze {int(maze[bad][0])}, which the disc of radius "
                f"{self.PLAYER_RADIUS} overlaps. Keep it {self.PLAYER_RADIUS} tiles away, e.g. "
                f"at a tile's centre."
            )

    def _distance_to_walls(self, position: Tensor, maze: Tensor) -> Tensor:
        """Distance of points inside the maze to the nearest of the tiles around, if solid, [*B]."""
        solid = torch.nn.functional.pad(self.mazes, (1, 1, 1, 1), value=True)  # [M, H + 2, W + 2]
        around = torch.cartesian_prod(*2 * [torch.arange(-1, 2, device=position.device)])  # [9, 2]
        point = position.unsqueeze(-2)
        tile = point.long() + around  # [*B, 9, 2] (x, y) of the low corner
        gap = torch.maximum(tile - point, point - tile - 1).clamp_min(0).norm(dim=-1)
        is_solid = solid[maze.unsqueeze(-1), tile[..., 1] + 1, tile[..., 0] + 1]
        return gap.masked_fill(~is_solid, torch.inf).amin(-1)

    def make_state(
        self,
        maze_index: Any,
        position: Any,
        target: Any,
        *,
        velocity: Any = (0.0, 0.0),
        step_count: Any = 0,
        heading: Any = (1.0, 0.0),
        items: Any = None,
    ) -> TensorDict:
        """Build a state, to step from or to pass to ``reset(td, set_state=True)``.

        Args:
            maze_index (int or Tensor): int64 ``[*B]``, index into ``env.mazes``.
            position (sequence or Tensor): float ``[*B, 2]``, (x, y) of the disc, tiles.
            target (sequence or Tensor): float ``[*B, 2]``, (x, y) of the target, tiles.
            velocity (sequence or Tensor): float ``[*B, 2]``, tiles per second. Default at rest.
            step_count (int or Tensor): base steps already taken, ``[*B]``. Default 0.
            heading (sequence or Tensor): of a boat, float ``[*B, 2]``, a unit vector; rounded to
                one of 32. Default to the right.
            items (sequence or Tensor, optional): bool ``[*B, K]``, True where an item lies, in a
                maze with items. Default: all.

        Returns:
            TensorDict ``[*B]`` as ``env.reset()`` gives it; the arguments are broadcast to ``*B``.

        Raises:
            ValueError: if a value is not finite, out of range or inside a wall, or the disc
                overlaps one.
        """
        device = self.device
        maze, steps = (torch.as_tensor(x, device=device) for x in (maze_index, step_count))
        points = [
            torch.as_tensor(x, dtype=torch.float32, device=device)
            for x in (position, velocity, target, heading)
        ]
        names = ("position", "velocity", "target", "heading")
        for name, point in zip(names, points, strict=True):
            if not point.ndim or point.shape[-1] != 2:
                raise ValueError(f"{name} must be (x, y) pairs [*B, 2]; got {list(point.shape)}.")
        shape = torch.broadcast_shapes(maze.shape, steps.shape, *(p.shape[:-1] for p in points))
        maze, steps = (x.to(torch.int64).expand(shape).clone() for x in (maze, steps))
        at, moving, goal, ahead = (point.expand(*shape, 2).clone() for point in points)
        steps = steps.unsqueeze(-1)
        values = {"position": at, "velocity": moving, "target": goal}
        values |= {"maze_index": maze, "step_count": steps}
        entries = {}
        if self.steering == "heading":
            entries["heading"] = ahead
        if self.items is not None:
            lying = self._all_items(shape) if items is None else torch.as_tensor(items)
            entries["items"] = lying.to(device).expand(*shape, self.items.count).clone()
        self._check_form(values | entries, shape)
        self._check_places(at, goal, maze)
        state = self._write_state(at, moving, goal, maze, steps, shape, **entries)
        return state.update({k: torch.zeros_like(steps, dtype=torch.bool) for k in self.done_keys})

    def draw_map(self, axes: Any, tensordict: TensorDictBase) -> None:
        super().draw_map(axes, tensordict)
        if self._placed is not None:
            self._placed.draw(axes, int(tensordict["maze_index"]))

    def _draw(self, tensordict: TensorDictBase, options: dict[str, Any]) -> np.ndarray:
        if self._placed is not None:
            lying = self._placed.places[int(tensordict["maze_index"])][tensordict["items"].numpy()]
            options = {"dots": lying, **options}
        if self.steering == "heading":
            bow = tensordict["position"] + 0.45 * tensordict["heading"]
            line = (torch.stack((tensordict["position"], bow)).numpy(), PLAYER_COLOR)
            options = {**options, "paths": [*options.get("paths", ()), line]}
        return draw_maze(
            self.mazes[tensordict["maze_index"]].cpu(),
            player=tensordict["position"].tolist(),
            player_radius=self.PLAYER_RADIUS,
            target=tensordict["target"].tolist(),
            target_radius=self.TARGET_RADIUS,
            **options,
        )
