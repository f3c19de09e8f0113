"""A network that reads a maze of tiles: which option to prefer, and how far the target is.

Letters: *B batch of states, m states in one dimension, U mazes with their targets, H rows, W
columns, A options, C channels.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F

_FAR = 99.0  # tiles, farther than any tile can be
_STEPS_PER_TILE = 15.0  # base steps, at the speed that thrust reaches
_NEIGHBOURS = tuple((dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx)
_TARGET_STEPS_PER_TILE = 256  # targets are told apart to that fraction of a tile
_CACHE_SIZE = 4096


class MazeNetwork(TensorDictModuleBase):
    r"""Prior and value for mazes of tiles: learned step costs, shortest paths, a small head.

    A convolution over the walls of ``mazes``, bool ``[M, H, W]``, gives each tile the costs
    :math:`c > 0` of moving to its 8 neighbours. Shortest paths by these costs give each tile its
    distance to the target,

    .. math:: d(x) = \min\bigl(d_0(x),\ \min_{y \in N(x)} c(x, y) + d(y)\bigr), \qquad
              d_0(x) = \lVert x - x_{target} \rVert_\infty \text{ if below 1, else far,}

    through which gradients flow along the shortest paths: value iteration inside the network, in
    logarithms of values. A fully connected head reads the distances and walls of the 3 x 3 tiles
    around the player, its place in its tile, its velocity and the near target, and writes
    ``"logits"`` of the options, ``[*B, A]``, and the base steps :math:`n` to the target; the
    ``"state_value"``, ``[*B, 1]``, is :math:`\gamma^n`.

    Without gradients the distances of a maze and its target are computed once and kept until a
    weight changes, so that a planner pays only for the head at each node of a tree.

    Reference:
        Tamar et al., "Value iteration networks", 2016, arXiv 1602.02867, for planning inside a
        network.

    Example:
        >>> import torch
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> env = WaterworldMazeEnv(batch_size=[3])
        >>> td = MazeNetwork(env.mazes)(env.reset())
        >>> td["logits"].shape, td["state_value"].shape
        (torch.Size([3, 4]), torch.Size([3, 1]))
    """

    KEYS = ("position", "velocity", "target", "maze_index")
    out_keys = ["logits", "state_value"]

    def __init__(
        self,
        mazes: Tensor,
        num_options: int = 4,
        *,
        gamma: float = 0.99,
    ) -> None:
        super().__init__()
        self.in_keys = list(self.KEYS)
        if not 0.0 < gamma < 1.0:
            raise ValueError(
                f"MazeNetwork writes values gamma ** n, so gamma must lie in (0, 1); got {gamma}."
            )
        self.gamma = gamma
        self.num_options = num_options
        first, last = nn.Conv2d(1, 32, 3, padding=1), nn.Conv2d(32, 8, 1)
        assert last.bias is not None
        with torch.no_grad():  # at first all moves cost about a tile
            last.weight.mul_(0.3)
            last.bias.fill_(0.54)
        self.costs = nn.Sequential(first, nn.ReLU(), last)
        self.head = nn.Sequential(
            nn.Linear(9 + 9 + 6, 64),
            nn.ReLU(),
            nn.Linear(64, 64),
            nn.ReLU(),
            nn.Linear(64, num_options + 1),
        )
        self._set_mazes(mazes)

    def _set_mazes(self, mazes: Tensor) -> None:
        if mazes.ndim != 3:
            raise ValueError(
                f"MazeNetwork needs mazes [M, H, W]; got the shape {list(mazes.shape)}. Pass e.g. "
                f"env.mazes, or maze[None] for one."
            )
        # Plain attributes: a network trained in some mazes is used in others.
        self.__dict__["free"] = (~mazes).to(torch.float32)  # [M, H, W]
        self.__dict__["_cache"] = _FieldCache()

    def on(self, mazes: Tensor) -> MazeNetwork:
        """Return this network for other mazes; both have the same parameters."""
        other = copy.copy(self)
        other._set_mazes(mazes)
        return other

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> MazeNetwork:
        super()._apply(fn, recurse)
        self.__dict__["free"] = fn(self.free)
        self._cache.clear()
        return self

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write logits and values."""
        shape = tensordict.batch_size
        position, velocity, target, maze = (tensordict.get(key) for key in self.in_keys)
        maze = maze.reshape(-1)
        fields, row = self._fields(maze, target.reshape(-1, 2))
        out = self._read(
            fields, row, position.reshape(-1, 2), velocity.reshape(-1, 2), target.reshape(-1, 2)
        )
        out = out.reshape(*shape, self.num_options + 1)
        tensordict.set("logits", out[..., :-1])
        tensordict.set("state_value", self.gamma ** out[..., -1:])
        return tensordict

    def _fields(self, maze: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Distances and free tiles, padded, ``[U, 2, H + 2, W + 2]``, and each state's row."""
        scaled = (target * _TARGET_STEPS_PER_TILE).round().to(torch.int64)
        keys = (maze << 40) | (scaled[:, 0] << 20) | scaled[:, 1]
        unique, first, row = np.unique(
            keys.numpy(force=True), return_index=True, return_inverse=True
        )
        rows = torch.from_numpy(row.reshape(-1)).to(maze.device)

        def compute(which: np.ndarray) -> Tensor:
            index = torch.from_numpy(first[which]).to(maze.device)
            # The rounded target: what is kept must not depend on who asked for it first.
            return self.fields(maze[index], scaled[index] / _TARGET_STEPS_PER_TILE)

        if torch.is_grad_enabled() or any(p.is_inference() for p in self.parameters()):
            return compute(np.arange(len(unique))), rows
        version = [(id(p), p._version) for p in self.parameters()]
        return self._cache.look_up(unique.tolist(), compute, version), rows

    def fields(self, maze: Tensor, target: Tensor) -> Tensor:
        """Return what is known of mazes ``[U]`` and targets ``[U, 2]`` before looking at states.

        That is the distance to the target in tiles, and 1 where a tile is free; both with one tile
        around the maze, ``[U, 2, H + 2, W + 2]``.
        """
        free = self.free[maze]  # [U, H, W]
        costs = F.softplus(self.costs(free[:, None])) + 0.01
        height, width = free.shape[1:]
        dx = (target[:, :1] - torch.arange(width, device=free.device) - 0.5).abs()
        dy = (target[:, 1:] - torch.arange(height, device=free.device) - 0.5).abs()
        start = torch.maximum(dy[:, :, None], dx[:, None, :])
        start = torch.where(start < 1.0, start, torch.full_like(start, _FAR))
        distance = shortest_distances(costs, start)
        planes = torch.stack((distance, free), 1)
        padded = F.pad(planes, (1, 1, 1, 1))
        padded[:, 0] += _FAR * (1.0 - F.pad(torch.ones_like(free), (1, 1, 1, 1)))
        return padded

    def _read(
        self, fields: Tensor, row: Tensor, position: Tensor, velocity: Tensor, target: Tensor
    ) -> Tensor:
        """Logits and base steps to the target of states ``[m]``, ``[m, A + 1]``."""
        height, width = fields.shape[2] - 2, fields.shape[3] - 2
        x = position[:, 0].floor().clamp(0, width - 1)
        y = position[:, 1].floor().clamp(0, height - 1)
        corner = (y * (width + 2) + x).to(torch.int64)  # of the 3 x 3 tiles, in a padded maze
        offsets = torch.arange(3, device=row.device)
        offsets = (offsets[:, None] * (width + 2) + offsets).reshape(-1)
        patch = fields.flatten(2)[row[:, None], :, corner[:, None] + offsets]  # [m, 9, 2]
        distance, free = patch.unbind(-1)
        here = distance[:, 4:5]
        around = (distance - here).clamp(-5.0, 5.0)
        inside = torch.stack((position[:, 0] - x - 0.5, position[:, 1] - y - 0.5), -1)
        near = (target - position).clamp(-1.5, 1.5)
        out = self.head(
            torch.cat((around[:, :4], here, around[:, 5:], free, inside, velocity, near), -1)
        )
        steps = _STEPS_PER_TILE * F.softplus(here + out[:, -1:])
        return torch.cat((out[:, :-1], steps), -1)


class _FieldCache:
    """Fields ``[U, 2, H + 2, W + 2]`` by maze and target, for the present weights."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        self.rows: dict[int, int] = {}
        self.stored: Tensor | None = None
        self.version: list[tuple[int, int]] | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> _FieldCache:
        return _FieldCache()

    def look_up(
        self,
        keys: list[int],
        compute: Callable[[np.ndarray], Tensor],
        version: list[tuple[int, int]],
    ) -> Tensor:
        if version != self.version or len(self.rows) + len(keys) > max(_CACHE_SIZE, len(keys)):
            self.clear()
            self.version = version
        missing = [i for i, key in enumerate(keys) if key not in self.rows]
        if missing:
            new = compute(np.array(missing))
            self.stored = new if self.stored is None else torch.cat((self.stored, new))
            for i in missing:
                self.rows[keys[i]] = len(self.rows)
        assert self.stored is not None
        return self.stored[
            torch.tensor([self.rows[key] for key in keys], device=self.stored.device)
        ]


def shortest_distances(costs: Tensor, start: Tensor) -> Tensor:
    r"""Return each tile's distance to the nearest source, with gradients along shortest paths.

    .. math:: d(x) = \min\bigl(d_0(x),\ \min_{y \in N(x)} c(x, y) + d(y)\bigr), \qquad
              \frac{\partial d(x)}{\partial c(y, z)} = 1 \text{ if } (y, z) \text{ is on the path}

    of costs of moving to the 8 neighbours, row by row, ``[U, 8, H, W]``, and the distances with
    which paths may end, ``[U, H, W]``.
    """
    distances: Tensor = _ShortestDistances.apply(costs, start)
    return distances


class _ShortestDistances(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, costs: Tensor, start: Tensor) -> Tensor:
        num, height, width = start.shape
        costs = costs.transpose(0, 1).contiguous()  # [8, U, H, W]
        padded = F.pad(start, (1, 1, 1, 1), value=float("inf"))  # updated in place
        around = [
            padded[:, 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] for dy, dx in _NEIGHBOURS
        ]
        inner = padded[:, 1:-1, 1:-1]
        reached = torch.empty_like(costs)
        while True:
            for out, cost, neighbour in zip(reached, costs, around, strict=True):
                torch.add(cost, neighbour, out=out)
            best = torch.minimum(start, reached.amin(0))
            if torch.equal(best, inner):
                break
            inner.copy_(best)
        value, move = reached.min(0)
        move = torch.where(value < start, move, torch.full_like(move, 8))  # 8: the path ends
        ctx.save_for_backward(move)
        return best

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        (move,) = ctx.saved_tensors
        num, height, width = move.shape
        moves = torch.tensor([dy * width + dx for dy, dx in _NEIGHBOURS] + [0], device=grad.device)
        index = torch.arange(move.numel(), device=grad.device)
        move = move.reshape(-1)
        following = index + moves[move]
        goes_on = move < 8
        flow = grad.reshape(-1).clone()  # what arrives at a tile in this step of the paths
        total = flow.clone()
        while True:
            flow = torch.zeros_like(flow).index_add_(0, following, flow * goes_on)
            if not flow.any():
                break
            total += flow
        costs = torch.zeros(9, move.numel(), dtype=grad.dtype, device=grad.device)
        costs[move, index] = total
        costs = costs.view(9, num, height, width)
        return costs[:8].transpose(0, 1), costs[8]
