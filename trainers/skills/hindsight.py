"""What networks see of Waterworld, and base steps that serve for targets they happened to reach.

Letters: C copies, T base steps of each, *B batch of the tensordict, b batch of an update.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.checks import whole_number


class MazeView(TensorDictModuleBase):
    r"""Writes what lies around the disc: where it is in its tile, how it moves, and the walls.

    Reads ``"position"``, ``"velocity"`` and ``"maze_index"``. The features are the position within
    the tile (2, from -1 to 1), the velocity (2) and the walls of the surrounding
    ``(2 reach + 1) ** 2`` tiles (1 is solid, as is all outside).

    Args:
        mazes: bool ``[M, H, W]`` of the env that is viewed.
        reach: tiles seen in each direction. Default 2.
        out_key: entry written, float32 ``[*B, F]``. Default ``"view"``.
    """

    def __init__(self, mazes: Tensor, *, reach: int = 2, out_key: NestedKey = "view") -> None:
        super().__init__()
        reach = whole_number("MazeView", "reach", reach)
        self.reach = reach
        self.in_keys: list[NestedKey] = ["position", "velocity", "maze_index"]
        self.out_keys = [out_key]
        solid = torch.nn.functional.pad(mazes, (reach,) * 4, value=True)  # [M, H', W']
        span = torch.arange(2 * reach + 1)
        self.num_features = 4 + len(span) ** 2
        self._shape = solid.shape
        self.register_buffer("_solid", solid.to(torch.float32).flatten(), persistent=False)
        offsets = (span[:, None] * solid.shape[2] + span).flatten()
        self.register_buffer("_offsets", offsets, persistent=False)

    _solid: Tensor
    _offsets: Tensor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the view of each row, ``[*B, F]``."""
        position = tensordict.get("position")
        tile = position.long()
        _, height, width = self._shape
        corner = (tensordict.get("maze_index") * height + tile[..., 1]) * width + tile[..., 0]
        walls = self._solid[corner.unsqueeze(-1) + self._offsets]
        within = 2.0 * (position - tile) - 1.0
        view = torch.cat((within, tensordict.get("velocity"), walls), -1)
        return tensordict.set(self.out_keys[0], view)


class HindsightTransitions:
    r"""Pieces of options from stored base steps, with targets that may have been reached.

    A piece is ``every`` base steps of one option. Half of the targets are places that the same
    episode reached later, the others places it visited at any time. The reward of a piece is
    :math:`\gamma^i` if its base step ``i`` touches the target, which also terminates it.

    Args:
        data: base transitions ``[C, T]`` with ``"skill"`` and ``"skill_step"``.
        view: writes what networks see of a state.
        touch: distance from the target, tiles, at which it is reached.
        every: base steps of a piece.
        horizon: base steps within which a place that was reached serves as a target.
        gamma: discount per base step.
        seed: of the draws.

    Raises:
        ValueError: if the data hold no whole piece.
    """

    def __init__(
        self,
        data: TensorDictBase,
        view: MazeView,
        *,
        touch: float,
        every: int = 5,
        horizon: int = 100,
        gamma: float = 0.98,
        seed: int = 0,
    ) -> None:
        copies, length = data.batch_size
        done = data["next", "done"].squeeze(-1)
        # Places before each step, and the one after the last.
        self.position = torch.cat((data["position"], data["next", "position"][:, -1:]), 1)
        self.after = data["next", "position"]  # [C, T, 2]
        self.view = view(data.copy())[view.out_keys[0]]  # [C, T, F]
        self.view_after = view(data["next"].copy())[view.out_keys[0]]
        self.skill = data["skill"]  # [C, T]
        self.skill_step = data["skill_step"].squeeze(-1)  # [C, T]
        time = torch.arange(length)
        # First and last base step of the episode that each base step belongs to.
        begins = torch.cat((torch.ones(copies, 1, dtype=torch.bool), done[:, :-1]), 1)
        self.first = torch.where(begins, time, 0).cummax(1).values
        ends = torch.where(done, time, length - 1)
        self.last = ends.flip(1).cummin(1).values.flip(1)
        m = every
        whole = torch.zeros(copies, length, dtype=torch.bool)
        same = self.skill_step[:, m - 1 :] == self.skill_step[:, : length - m + 1] + m - 1
        whole[:, : length - m + 1] = same & (
            self.first[:, m - 1 :] == self.first[:, : length - m + 1]
        )
        self.pieces = whole.nonzero()  # [P, 2] of copy and base step
        if not len(self.pieces):
            raise ValueError(
                f"The data hold no piece of an option of every={m} base steps; they are "
                f"{length} base steps of {copies} copies. Collect more, or make it shorter."
            )
        self.every, self.horizon, self.gamma = every, horizon, gamma
        self.touch = touch
        self.generator = torch.Generator().manual_seed(seed)

    def sample(self, batch_size: int) -> TensorDict:
        """Return at most ``batch_size`` transitions ``[b]``, none of which begins at its target.

        ``"begin"`` holds what an earlier step of the same option saw, where it may have begun.
        """

        def draw(low: Tensor, high: Tensor) -> Tensor:  # both included
            share = torch.rand(low.shape, generator=self.generator)
            return low + ((high - low + 1) * share).long()

        index = torch.randint(len(self.pieces), (batch_size,), generator=self.generator)
        copy, step = self.pieces[index].unbind(-1)
        first, last = self.first[copy, step], self.last[copy, step]
        later = draw(step, (step + self.horizon).clamp_max(last))
        chosen = torch.where(
            torch.rand(batch_size, generator=self.generator) < 0.5, later, draw(first, last)
        )
        target = self.after[copy, chosen]  # [b, 2]
        begun = draw((step - self.skill_step[copy, step]).clamp_min(first), step)
        span = step.unsqueeze(-1) + torch.arange(self.every)
        path = self.after[copy.unsqueeze(-1), span]  # [b, every, 2]
        hit = (path - target.unsqueeze(1)).norm(dim=-1) < self.touch
        reached = hit.any(-1)
        when = hit.to(torch.int64).argmax(-1)
        reward = torch.where(reached, self.gamma**when, 0.0)
        there = (self.position[copy, step] - target).norm(dim=-1) < self.touch
        end = step + self.every - 1

        def seen(view: Tensor, place: Tensor) -> dict[str, Tensor]:
            return {"view": view, "offset": target - place}

        size = [batch_size]
        out = TensorDict(
            {
                **seen(self.view[copy, step], self.position[copy, step]),
                "skill": self.skill[copy, step],
                "begin": TensorDict(
                    seen(self.view[copy, begun], self.position[copy, begun]), batch_size=size
                ),
                "next": TensorDict(
                    {
                        **seen(self.view_after[copy, end], self.after[copy, end]),
                        "reward": reward.unsqueeze(-1),
                        "terminated": reached.unsqueeze(-1),
                        "duration": torch.full((batch_size, 1), self.every),
                    },
                    batch_size=size,
                ),
            },
            batch_size=size,
        )
        return out[~there]
