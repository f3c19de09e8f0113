"""A stateless env in a maze: specs, seeds, resets to a state and pictures, for all mazes.

Letters: *B batch of the tensordict, M mazes, H rows, W columns, F free tiles.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from torchrl_hmcts import notebook
from torchrl_hmcts.checks import instance, whole_number
from torchrl_hmcts.envs.mazes.layouts import check_mazes, free_tiles, maze_pool, wall_centers
from torchrl_hmcts.envs.mazes.rendering import draw_goal, draw_walls


class MazeEnv(EnvBase):
    """A maze whose state is in the tensordict: any batch can be stepped, and set to any state."""

    batch_locked = False
    _supports_set_state = True
    make_state_call = "env.make_state(...)"
    """Names the call that builds a state, in errors."""

    def _start(
        self, batch_size: Sequence[int], device: torch.device | str | None, **flags: bool
    ) -> None:
        """Begin the construction, after checking what all mazes are given."""
        owner = type(self).__name__
        for name, flag in flags.items():
            instance(owner, name, flag, bool, np.bool_)
        instance(owner, "batch_size", batch_size, tuple, list)
        size = [whole_number(owner, "each of batch_size", n, least=1) for n in batch_size]
        try:
            torch.empty(0, device=device)
        except (RuntimeError, TypeError) as error:
            raise ValueError(f"{owner} cannot use device={device!r}: {error}") from error
        EnvBase.__init__(self, device=device, batch_size=torch.Size(size))

    def _set_up(
        self,
        state: dict[str, TensorSpec],  # of one state
        read_outs: dict[str, TensorSpec],  # what is observed besides, of one state
        action: TensorSpec,
        seed: int | None,
        free: Sequence[str] = (),  # entries of which a subclass checks the range
    ) -> None:
        """Set the specs, and seed the env."""
        device, batch_size = self.device, self.batch_size
        self._limits = {key: _limits(spec) for key, spec in state.items()}
        self._free_keys = set(free)
        observed = {key: spec.clone() for key, spec in state.items()} | read_outs
        self.state_spec = Composite(state, device=device).expand(batch_size)
        self.observation_spec = Composite(observed, device=device).expand(batch_size)
        self.action_spec = action.expand(*batch_size, *action.shape)
        reward = Unbounded(shape=(1,), dtype=torch.float32, device=device)
        self.reward_spec = reward.expand(*batch_size, 1)
        done = {key: Binary(1, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(done, device=device).expand(batch_size)
        if seed is None:
            seed = int(torch.empty((), dtype=torch.int64).random_())
        self.set_seed(whole_number(type(self).__name__, "seed", seed))

    def _set_seed(self, seed: int | None) -> None:
        # On the CPU whatever the device: a seed gives the same episodes everywhere.
        self._generator = torch.Generator()
        if seed is None:
            self._generator.seed()
        else:
            self._generator.manual_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if kwargs.get("set_state"):
            return self._reset_to_state(tensordict)
        return self._begin(self.batch_size if tensordict is None else tensordict.batch_size)

    @abstractmethod
    def _begin(self, shape: torch.Size) -> TensorDict:
        """Draw the first states of episodes."""

    def _pack(self, entries: dict[str, Tensor], shape: torch.Size) -> TensorDict:
        """Make a tensordict without the checks of its constructor, which cost as much as a step."""
        return TensorDict._new_unsafe(entries, shape, device=self.device)

    @abstractmethod
    def _reset_to_state(self, tensordict: TensorDictBase | None) -> TensorDict:
        """Write the state in a tensordict, after checking it."""

    def _state_of(self, tensordict: TensorDictBase | None) -> list[Tensor]:
        """Return the entries of a state, after checking that they have its form and range."""
        missing = [k for k in self._limits if tensordict is None or k not in tensordict.keys()]
        if tensordict is None or missing:
            raise ValueError(
                f"reset(td, set_state=True) needs the whole state in td; missing: {missing}. Build "
                f"it with {self.make_state_call}."
            )
        values = [tensordict.get(key) for key in self._limits]
        self._check_form(dict(zip(self._limits, values, strict=True)), tensordict.batch_size)
        return values

    def _check_form(self, state: dict[str, Tensor], batch_size: torch.Size) -> None:
        for key, value in state.items():
            dtype, trailing, low, high = self._limits[key]
            shape = [*batch_size, *trailing]
            if value.dtype != dtype or list(value.shape) != shape:
                raise ValueError(
                    f'"{key}" must be {dtype} {shape}; got {value.dtype} {list(value.shape)}. '
                    f"{self.make_state_call} builds a state of the right form."
                )
            if not torch.isfinite(value).all():
                raise ValueError(
                    f'"{key}" = {value[~torch.isfinite(value)][0].item()} is not finite. A state '
                    f"with NaN or infinity cannot be simulated; find the step that wrote it."
                )
            if key in self._free_keys:
                continue
            bad = (value < low.to(value.device)) | (value > high.to(value.device))
            if bad.any():
                column = int(bad.nonzero()[0][-1]) if low.ndim else 0
                name = f'"{key}"' + f"[..., {column}]" * (high.unique().numel() > 1)
                ends = [float(x.reshape(-1)[column]) for x in (low, high)]
                raise ValueError(
                    f"{name} = {value[bad][0].item()} is out of range: {ends[0]:g} to "
                    f"{ends[1]:g} are allowed."
                )

    def render(self, tensordict: TensorDictBase, **options: Any) -> Any:
        """Draw one state.

        Args:
            tensordict (TensorDictBase): state without batch dimensions, as from ``reset`` or
                ``step(...)["next"]``.
            **options: keywords of :func:`~torchrl_hmcts.envs.draw_maze` (``paths``, ``dots``,
                ``tile_pixels``).

        Returns:
            uint8 numpy array ``[h, w, 3]``.

        Raises:
            ValueError: if the tensordict has batch dimensions.
        """
        if tensordict.batch_size:
            raise ValueError(
                f"render draws one state, got a batch {list(tensordict.batch_size)}. Index it, "
                f"e.g. env.render(td[0])."
            )
        return self._draw(tensordict, options)

    @abstractmethod
    def draw_map(self, axes: Any, tensordict: TensorDictBase) -> None:
        """Draw walls and target of a state in matplotlib axes, in the units of ``"position"``."""

    def _repr_html_(self) -> str:
        first = TensorDict({"maze_index": torch.tensor(0)})
        return notebook.shown(f"{self!r}, its first maze:", lambda axes: self.draw_map(axes, first))

    @abstractmethod
    def _draw(self, tensordict: TensorDictBase, options: dict[str, Any]) -> Any:
        """Draw a state without batch dimensions."""


def _limits(spec: TensorSpec) -> tuple[torch.dtype, list[int], Tensor, Tensor]:
    """Dtype, shape and bounds of an entry."""
    if isinstance(spec, Bounded):
        low, high = spec.space.low.cpu(), spec.space.high.cpu()
    elif isinstance(spec, Binary):
        low, high = torch.tensor(0), torch.tensor(1)
    else:
        low, high = torch.tensor(0), torch.tensor(int(spec.space.n) - 1)
    return spec.dtype, list(spec.shape), low, high


class TileMazeEnv(MazeEnv):
    """A maze of tiles with a player and a target, one of many in a tensor."""

    tables: tuple[str, ...] = ("mazes", "_wall_centers", "_free_tiles")
    """Tensors that move with the env."""

    def __init__(
        self,
        mazes: Tensor | None,
        max_steps: int,
        observation: bool,
        batch_size: Sequence[int],
        device: torch.device | str | None,
    ) -> None:
        mazes = maze_pool("train") if mazes is None else mazes
        check_mazes(mazes)
        max_steps = whole_number(type(self).__name__, "max_steps", max_steps, least=1)
        self._start(batch_size, device, observation=observation)
        self.num_mazes, self.height, self.width = mazes.shape
        self.num_walls = int(mazes[0].sum())
        self.max_steps = max_steps
        self._writes_observation = observation
        # Plain attributes, not buffers: EnvBase makes the lookup of a buffer slower than the step.
        self.mazes = mazes.to(self.device).clone()  # [M, H, W]
        self._wall_centers = wall_centers(self.mazes).flatten(1)  # [M, 2K]
        self._free_tiles = free_tiles(self.mazes)  # [M, F]

    def draw_map(self, axes: Any, tensordict: TensorDictBase) -> None:
        draw_walls(axes, self.mazes[int(tensordict["maze_index"])].cpu())
        if "target" in tensordict.keys():
            draw_goal(axes, tensordict["target"].tolist())

    def to(self, device: torch.device | str) -> Any:
        """Move the env, its mazes and its tables to a device, in place."""
        super().to(device)
        for name in self.tables:
            setattr(self, name, getattr(self, name).to(device))
        return self

    def _counted(self) -> dict[str, TensorSpec]:
        """The specs that both kinds of state have."""
        return {
            "maze_index": Categorical(self.num_mazes, shape=(), device=self.device),
            "step_count": Bounded(
                0, self.max_steps, shape=(1,), dtype=torch.int64, device=self.device
            ),
        }

    def _draw_tiles(self, shape: torch.Size) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draw mazes, tiles of players and targets, and a count of steps of 0."""
        num_free = self._free_tiles.shape[1]

        def draw(high: int) -> Tensor:
            return torch.randint(high, shape, generator=self._generator).to(self.device)

        maze, player, target = draw(self.num_mazes), draw(num_free), draw(num_free - 1)
        target += target >= player  # uniform over the free tiles other than the player's
        steps = torch.zeros((*shape, 1), dtype=torch.int64, device=self.device)
        first, second = (self._free_tiles.take(maze * num_free + t) for t in (player, target))
        return maze, first, second, steps

    def _observed(self, entries: dict[str, Tensor], shape: torch.Size) -> TensorDict:
        """Pack entries, with ``"observation"``, of the positions and the walls, if it is wanted."""
        if self._writes_observation:
            walls = torch.embedding(self._wall_centers, entries["maze_index"])
            places = (entries["position"], entries["target"], walls)
            entries["observation"] = torch.cat(places, -1)
        return self._pack(entries, shape)
