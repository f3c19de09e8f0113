"""A script that walks the shortest path: how many frames the goal of a lab maze takes at least.

Letters: M episodes, one per maze; R rows and C columns of cells, the north first.
"""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_hmcts.envs import LabMazeEnv, shortest_path_lengths

_NEAR = 30.0  # world units from a cell's centre at which the script turns to the next
_DEGREES_PER_PIXEL = 0.0066  # per millisecond of a frame
_SIDES = np.array([(0, 1), (0, -1), (-1, 0), (1, 0)])  # row, column: east, west, north, south


class ShortestPathScript:
    """Walks from cell to cell along a shortest path: turns to the next centre and walks there.

    It knows the maze and needs no learning: a reference for how long an episode takes, not a bound
    (it does not cut corners, nor does it brake before them). It plays an env's mazes in an env of
    its own, frame by frame.

    Reference:
        Dissertation, section 4.3.1, whose mazes take "thousands of time steps".

    Example:
        >>> from torchrl_hmcts.envs import LabMazeEnv
        >>> env = LabMazeEnv([["*******", "*P   G*", "*******"]])
        >>> start = env.make_state([0], (150.0, 150.0), heading=0.0)
        >>> ShortestPathScript(env).frames(start).tolist()  # 4 cells, at 5 units a frame
        [73]
    """

    def __init__(self, env: LabMazeEnv) -> None:
        layout = env.layout
        if (layout.goal[:, 0] < 0).any():
            raise ValueError(
                f"ShortestPathScript walks to the goal; maze {int(layout.goal[:, 0].argmin())} has "
                f"none. Mark one with 'G'."
            )
        self.env = LabMazeEnv(
            layout.text,
            actions=None,
            max_frames=env.max_frames,
            fps=env.fps,
            clock="exact" if env.exact_clock else "constant",
            clock_phase=env.clock_phase,
            friction=env.friction,
            read_outs=("heading",),
        )
        goals = [tuple(reversed(cell)) for cell in self._cells(layout.goal).tolist()]
        far = np.iinfo(np.int64).max
        lengths = [
            shortest_path_lengths(torch.from_numpy(walls), goal)
            for walls, goal in zip(layout.walls, ((r, c) for c, r in goals), strict=True)
        ]
        self._lengths = np.stack([np.where(x < 0, far, x) for x in map(np.asarray, lengths)])

    def _cells(self, position: np.ndarray) -> np.ndarray:
        """Row and column of positions ``[..., 2]`` in world units."""
        column, south = (position // self.env.CELL).astype(np.int64).T
        return np.stack((self.env.layout.rows - 1 - south, column), -1)

    def path_lengths(self, starts: TensorDictBase) -> np.ndarray:
        """Return the cells from each start ``[M]`` to the goal, int64 ``[M]``."""
        row, column = self._cells(starts["position"].numpy()).T
        lengths: np.ndarray = self._lengths[starts["maze_index"].numpy(), row, column]
        return lengths

    def frames(self, starts: TensorDictBase) -> np.ndarray:
        """Walk from each start ``[M]``; return the frames to the goal, int64 ``[M]``.

        A walk that ends without the goal counts with the frames of the whole episode.
        """
        env, maze = self.env, starts["maze_index"].numpy()
        before = starts["level"][:, 3].numpy()
        cell = self._cells(starts["position"].numpy())
        td: TensorDictBase = starts.select(*env.state_spec.keys()).clone()
        heading = env.read_state(td)["heading"]
        while True:
            place = td["position"].numpy()
            aim = self._centre(cell)
            near = np.abs(aim - place).max(-1) < _NEAR
            cell[near] = self._next(maze[near], cell[near])
            action = self._action(self._centre(cell) - place, heading.numpy())
            after = env._step(td.set("action", action))
            td = after.select(*env.state_spec.keys())
            heading = after["heading"]
            if bool(after["done"].all()):
                gone: np.ndarray = td["level"][:, 3].numpy() - before
                return gone

    def _centre(self, cell: np.ndarray) -> np.ndarray:
        """The centres of cells in world units, ``[n, 2]``."""
        row, column = cell.T
        return self.env.CELL * (np.stack((column, self.env.layout.rows - 1 - row), -1) + 0.5)

    def _next(self, maze: np.ndarray, cell: np.ndarray) -> np.ndarray:
        """The neighbour of each cell that is nearest to the goal; the goal stays."""
        beside = np.concatenate((cell[:, None], cell[:, None] + _SIDES), 1)  # [n, 5, 2]
        lengths = self._lengths[maze[:, None], beside[..., 0], beside[..., 1]]
        best: np.ndarray = np.take_along_axis(beside, lengths.argmin(1)[:, None, None], 1)[:, 0]
        return best

    def _action(self, aim: np.ndarray, heading: np.ndarray) -> torch.Tensor:
        """The engine's action that turns towards ``aim`` and goes forward once it is ahead."""
        left = np.arctan2(aim[:, 1], aim[:, 0]) - np.arctan2(heading[:, 1], heading[:, 0])
        left = np.degrees((left + np.pi) % (2.0 * np.pi) - np.pi)
        pixels = -left / (_DEGREES_PER_PIXEL * self.env.frame_msec)
        action = np.zeros((len(aim), 7), np.int64)
        action[:, 0] = pixels.round().clip(-512, 512)
        action[:, 3] = np.abs(left) < 90.0
        return torch.from_numpy(action)
