"""Gridworld random maze: the discrete maze whose model a manager plans in.

Letters: *B batch of the tensordict, M mazes, H rows, W columns, K walls per maze, A = 5 actions. A
tile index is ``row * W + col``.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.base import NO_DEFAULT
from torch import Tensor
from torchrl.data import Bounded, Categorical

from torchrl_hmcts.envs.mazes.maze_env import TileMazeEnv
from torchrl_hmcts.envs.mazes.rendering import draw_maze

_MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1), (0, 0))  # (row, col) of up, down, left, right, none


class GridworldMazeEnv(TileMazeEnv):
    r"""Walk from tile to tile of a random maze until the target's tile is reached.

    Stateless and batched: the state is in the tensordict, any batch shape is stepped at once, and
    ``reset(td, set_state=True)`` continues from the state in ``td``. With :math:`n(m, s, a)` the
    tile entered from tile :math:`s` of maze :math:`m` (:math:`s` itself when a wall or the border
    is in the way) and :math:`t` the target's tile

    .. math:: s' = n(m, s, a), \qquad r = [s' = t], \qquad \text{terminated} = [s' = t].

    Actions: 0 up, 1 down, 2 left, 3 right, 4 none. State: ``"player_tile"``, ``"target_tile"``,
    ``"maze_index"`` (int64 ``[*B]``), ``"step_count"`` (int64 ``[*B, 1]``). Read-outs of it:
    ``"position"`` and ``"target"`` (float32 ``[*B, 2]``, tile centres (x, y)) and ``"observation"``
    (float32 ``[*B, 4 + 2 K]``: position, target, then the centres of the K walls in row-major
    order; 66 numbers for 31 walls).

    Args:
        mazes (Tensor, optional): bool ``[M, H, W]``, True = wall, equal numbers of walls. Default:
            the training split of :func:`~torchrl_hmcts.envs.maze_pool`.
        max_steps (int): steps after which an episode is truncated. Default 200, four times the 50
            free tiles of a pool maze.
        observation (bool): write ``"observation"``; planners that never read it save time. Default
            True.
        seed (int, optional): of the env's own generator; drawn from torch's global one by default.
        device (torch.device, optional): of all tensors. Default: CPU.

    Raises:
        ValueError: if the mazes are not usable (see :func:`~torchrl_hmcts.envs.check_mazes`) or
            ``max_steps`` is below 1.

    Reference:
        Dissertation, section 3.1.2 and figure 3.2. Reward and time limit are this project's.

    Example:
        >>> from torchrl_hmcts.envs import GridworldMazeEnv, maze_from_text
        >>> maze, player, target = maze_from_text("P#T\n...")
        >>> env = GridworldMazeEnv(maze[None])
        >>> td = env.make_state(0, player, target)
        >>> for action in (1, 3, 3, 0):  # down, right, right, up
        ...     td = env.step(td.set("action", torch.tensor(action)))["next"]
        >>> td["position"].tolist(), td["reward"].item(), td["terminated"].item()
        ([2.5, 0.5], 1.0, True)
        >>> env.rollout(5).shape
        torch.Size([5])
    """

    tables = (*TileMazeEnv.tables, "_next_tile", "_centers")
    make_state_call = (
        "env.make_state(maze_index, player, target) or "
        "env.state_from_positions(maze_index, position, target)"
    )
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        mazes: Tensor | None = None,
        *,
        max_steps: int = 200,
        observation: bool = True,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(mazes, max_steps, observation, (), device)
        self._num_tiles = self.height * self.width
        self._next_tile = _next_tile_table(self.mazes)  # [M, H*W, A]
        tiles = torch.arange(self._num_tiles, device=self.device)
        columns_rows = torch.stack((tiles % self.width, tiles // self.width), -1)
        self._centers = columns_rows + 0.5  # [H*W, 2]
        low, high = torch.tensor([0.5, 0.5]), torch.tensor([self.width, self.height]) - 0.5

        def centers(count: int) -> Bounded:
            return Bounded(low.repeat(count), high.repeat(count), device=self.device)

        state = {
            "player_tile": Categorical(self._num_tiles, shape=(), device=self.device),
            "target_tile": Categorical(self._num_tiles, shape=(), device=self.device),
            **self._counted(),
        }
        read_outs: dict[str, Any] = {"position": centers(1), "target": centers(1)}
        if self._writes_observation:
            read_outs["observation"] = centers(2 + self.num_walls)
        self._set_up(state, read_outs, Categorical(len(_MOVES), shape=(), device=self.device), seed)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        entry = tensordict._get_str  # TensorDict.get takes five times as long
        maze, target = entry("maze_index", NO_DEFAULT), entry("target_tile", NO_DEFAULT)
        index = torch.add(entry("player_tile", NO_DEFAULT), maze, alpha=self._num_tiles)
        index = torch.add(entry("action", NO_DEFAULT), index, alpha=len(_MOVES))
        player = self._next_tile.take(index)
        step_count = entry("step_count", NO_DEFAULT) + 1
        terminated = torch.eq(player, target).unsqueeze_(-1)
        truncated = step_count.ge(self.max_steps)
        return self._write_state(
            player,
            target,
            maze,
            step_count,
            tensordict.batch_size,
            reward=terminated.float(),
            terminated=terminated,
            truncated=truncated,
            done=terminated.logical_or(truncated),
        )

    def _write_state(
        self,
        player: Tensor,  # [*B]
        target: Tensor,  # [*B]
        maze: Tensor,  # [*B]
        step_count: Tensor,  # [*B, 1]
        batch_size: torch.Size,
        **entries: Tensor,
    ) -> TensorDict:
        position = torch.embedding(self._centers, player)
        target_position = torch.embedding(self._centers, target)
        entries.update(
            player_tile=player,
            target_tile=target,
            maze_index=maze,
            step_count=step_count,
            position=position,
            target=target_position,
        )
        return self._observed(entries, batch_size)

    def _begin(self, shape: torch.Size) -> TensorDict:
        maze, player, target, steps = self._draw_tiles(shape)
        return self._write_state(player, target, maze, steps, shape)

    def _reset_to_state(self, tensordict: TensorDictBase | None) -> TensorDict:
        player, target, maze, steps = self._state_of(tensordict)
        assert tensordict is not None
        self._check_tiles(player, target, maze)
        out = self._write_state(player, target, maze, steps, tensordict.batch_size)
        for key, tile_key in (("position", "player_tile"), ("target", "target_tile")):
            given = tensordict.get(key, None)
            if given is not None and not torch.equal(given, out.get(key)):
                raise ValueError(
                    f'"{key}" = {given.tolist()} contradicts "{tile_key}" = '
                    f"{tensordict.get(tile_key).tolist()}, whose centre is "
                    f"{out.get(key).tolist()}. The state is the tile: leave {key!r} "
                    f"out, or build it with env.state_from_positions(maze_index, position, target)."
                )
        return out

    def _check_tiles(self, player: Tensor, target: Tensor, maze: Tensor) -> None:
        for key, tile in (("player_tile", player), ("target_tile", target)):
            in_wall = self.mazes.flatten().take(maze * self._num_tiles + tile)
            if in_wall.any():
                bad_tile, bad_maze = int(tile[in_wall][0]), int(maze[in_wall][0])
                raise ValueError(
                    f'"{key}" = {bad_tile}, (row, col) = {divmod(bad_tile, self.width)}, is a wall '
                    f"of maze {bad_maze}. Choose a free tile, e.g. from "
                    f"free_tiles(env.mazes[{bad_maze}])."
                )

    def make_state(
        self, maze_index: Any, player: Any, target: Any, *, step_count: Any = 0
    ) -> TensorDict:
        """Build a state from tiles, to step from or to pass to ``reset(td, set_state=True)``.

        Args:
            maze_index (int or Tensor): int64 ``[*B]``, index into ``env.mazes``.
            player (sequence or Tensor): int64 ``[*B, 2]``, (row, col) of the player's tile.
            target (sequence or Tensor): int64 ``[*B, 2]``, (row, col) of the target's tile; when it
                is the player's, the next step that stays there is rewarded.
            step_count (int or Tensor): steps already taken, ``[*B]``. Default 0.

        Returns:
            TensorDict ``[*B]`` as ``env.reset()`` gives it; the arguments are broadcast to ``*B``.

        Raises:
            ValueError: if an index is out of range or a tile is a wall.
        """
        maze, steps = (torch.as_tensor(x, device=self.device) for x in (maze_index, step_count))
        size = torch.tensor([self.height, self.width], device=self.device)
        tiles = []
        for name, value in (("player", player), ("target", target)):
            tile = torch.as_tensor(value, device=self.device)
            if tile.is_floating_point() or not tile.ndim or tile.shape[-1] != 2:
                raise ValueError(
                    f"{name} must be integers [*B, 2], (row, col) of a tile; got {tile.dtype} "
                    f"{list(tile.shape)}. For positions use env.state_from_positions(...)."
                )
            if ((tile < 0) | (tile >= size)).any():
                raise ValueError(
                    f"{name} tile (row, col) = {tile.tolist()} is outside the "
                    f"{self.height}x{self.width} maze. Rows are 0 to {self.height - 1}, columns "
                    f"0 to {self.width - 1}."
                )
            tiles.append(tile[..., 0] * self.width + tile[..., 1])
        maze, player_tile, target_tile, steps = (
            x.to(torch.int64).clone() for x in torch.broadcast_tensors(maze, *tiles, steps)
        )
        steps = steps.unsqueeze(-1)
        values = (player_tile, target_tile, maze, steps)
        self._check_form(dict(zip(self._limits, values, strict=True)), maze.shape)
        self._check_tiles(player_tile, target_tile, maze)
        state = self._write_state(player_tile, target_tile, maze, steps, maze.shape)
        return state.update(self.full_done_spec.zero(maze.shape))

    def state_from_positions(
        self, maze_index: Any, position: Any, target: Any, *, step_count: Any = 0
    ) -> TensorDict:
        """Build the state of the tiles that hold two positions, e.g. those of a Waterworld state.

        Args:
            maze_index (int or Tensor): int64 ``[*B]``, index into ``env.mazes``; both envs need the
                same mazes.
            position (sequence or Tensor): float ``[*B, 2]``, (x, y) of the player in tiles.
            target (sequence or Tensor): float ``[*B, 2]``, (x, y) of the target in tiles.
            step_count (int or Tensor): steps already taken, ``[*B]``. Default 0.

        Returns:
            TensorDict ``[*B]`` as ``env.reset()`` gives it.

        Raises:
            ValueError: if a position is not finite, outside the maze or in a wall.

        Reference:
            Dissertation, section 3.1.2: the macro environment is made from the Waterworld state.
        """
        size = torch.tensor([self.width, self.height], device=self.device)
        tiles = []
        for name, value in (("position", position), ("target", target)):
            point = torch.as_tensor(value, dtype=torch.float32, device=self.device)
            if not ((point >= 0) & (point < size)).all():  # NaN fails too
                raise ValueError(
                    f"{name} (x, y) = {point.tolist()} is not inside the maze of "
                    f"{self.width} x {self.height} tiles. Pass finite coordinates in tiles."
                )
            tiles.append(point.floor().to(torch.int64).flip(-1))
        return self.make_state(maze_index, *tiles, step_count=step_count)

    def _draw(self, tensordict: TensorDictBase, options: dict[str, Any]) -> Any:
        return draw_maze(
            self.mazes[tensordict["maze_index"]].cpu(),
            player=tensordict["position"].tolist(),
            target=tensordict["target"].tolist(),
            **options,
        )


def _next_tile_table(mazes: Tensor) -> Tensor:
    """The tile entered by each action from each tile, int64 [M, H*W, A]; walls and borders stop."""
    num_mazes, height, width = mazes.shape
    rows = torch.arange(height, device=mazes.device)[:, None, None]
    cols = torch.arange(width, device=mazes.device)[:, None]
    moves = torch.tensor(_MOVES, device=mazes.device)  # [A, 2]
    next_rows = (rows + moves[:, 0]).clamp(0, height - 1)
    next_cols = (cols + moves[:, 1]).clamp(0, width - 1)
    moved = (next_rows * width + next_cols).view(-1)  # [H*W*A]
    stayed = (rows * width + cols).expand(height, width, len(_MOVES)).reshape(-1)
    blocked = mazes.flatten(1)[:, moved]  # [M, H*W*A]
    return torch.where(blocked, stayed, moved).view(num_mazes, height * width, len(_MOVES))
