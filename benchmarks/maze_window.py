"""A view of a maze for a network: a window of walls around the player.

Letters: *B batch of the tensordict, H rows, W columns, K walls, R tiles that the window reaches to
each side.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_hmcts.envs import WaterworldMazeEnv


class MazeWindow(TensorDictModuleBase):
    """What decides where an option leads: the walls around the player, its motion, the target.

    Writes ``"features"`` (float32 ``[*B, F]``): the walls of the (2 R + 1)^2 tiles around the
    player's; how far both rims of the disc can go in the four directions, up to R tiles; which of
    the tiles is the target's; the player's offset from its tile's centre, its velocity, the vector
    to the target (clipped to R tiles) and its length; and the option one-hot.
    Mazes are read from the observation, so that the features of a maze never seen are as good.
    """

    in_keys = ["observation", "position", "velocity", "target", "option"]
    out_keys = ["features"]

    def __init__(
        self, num_options: int, *, radius: int = 3, height: int = 9, width: int = 9
    ) -> None:
        super().__init__()
        self.num_options, self.radius = num_options, radius
        self.height, self.width = height, width
        side = 2 * radius + 1
        self.num_features = 2 * side**2 + 15 + num_options
        around = torch.arange(-radius, radius + 1)
        rows, columns = torch.meshgrid(around, around, indexing="ij")
        self._stride = width + 2 * radius
        offsets = ((rows + radius) * self._stride + columns + radius).reshape(-1)
        self.register_buffer("offsets", offsets, persistent=False)
        self.register_buffer("rows", rows.reshape(-1), persistent=False)
        self.register_buffer("columns", columns.reshape(-1), persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        position, velocity, target = (
            tensordict.get(key) for key in ("position", "velocity", "target")
        )
        size = position.new_tensor([self.width, self.height])
        tile = torch.minimum(position.clamp_min(0.0), size - 1.0).long()  # 9.0 is of the last one
        index = (tile[..., 1] * self._stride + tile[..., 0]).unsqueeze(-1) + self.offsets
        walls = self._solid(tensordict.get("observation")).gather(-1, index)
        ahead = target.long() - tile
        on_target = (ahead[..., 1:] == self.rows) & (ahead[..., :1] == self.columns)
        vector = target - position
        option = nn.functional.one_hot(tensordict.get("option"), self.num_options)
        features = torch.cat(
            (
                walls,
                self._free_ways(walls.unflatten(-1, (2 * self.radius + 1, -1)), position - tile),
                on_target.to(position.dtype),
                2.0 * (position - tile - 0.5),
                velocity,
                vector.clamp(-self.radius, self.radius),
                vector.norm(dim=-1, keepdim=True).clamp_max(self.radius),
                option.to(position.dtype),
            ),
            -1,
        )
        return tensordict.set("features", features)

    def _free_ways(self, walls: Tensor, inside: Tensor) -> Tensor:
        """How far both rims of the disc can go right, left, down and up, up to R, ``[*B, 8]``."""
        r, size = self.radius, WaterworldMazeEnv.PLAYER_RADIUS
        ways = []
        for axis, grid in ((0, walls), (1, walls.transpose(-2, -1))):  # the rows lie along it
            along, across = inside[..., axis : axis + 1], inside[..., 1 - axis : 2 - axis]
            for rim in (-size, size):
                lane = (across + rim).floor().long() + r
                row = grid.gather(-2, lane.unsqueeze(-1).expand(*lane.shape, 2 * r + 1))
                free = 1.0 - row.squeeze(-2)
                ways.append(free[..., r + 1 :].cumprod(-1).sum(-1, keepdim=True) + 1.0 - along)
                ways.append(free[..., :r].flip(-1).cumprod(-1).sum(-1, keepdim=True) + along)
        return (torch.cat(ways, -1) - size).clamp_max(r)

    def _solid(self, observation: Tensor) -> Tensor:
        """The maze with R solid tiles around it, float ``[*B, (H + 2 R) (W + 2 R)]``."""
        centers = observation[..., 4:].unflatten(-1, (-1, 2)).long() + self.radius
        shape = observation.shape[:-1]
        solid = observation.new_ones(*shape, self.height + 2 * self.radius, self._stride)
        r = self.radius
        solid[..., r : r + self.height, r : r + self.width] = 0.0
        index = centers[..., 1] * self._stride + centers[..., 0]
        return solid.flatten(-2).scatter(-1, index, 1.0)
