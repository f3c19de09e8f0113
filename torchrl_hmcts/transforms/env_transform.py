"""A base of the transforms here: they follow an env, and keep their state in the tensordict."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform


class EnvTransform(Transform):
    """A transform for envs only, that keeps its state in the tensordict from step to step."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse stored data, which hold what the transform writes already."""
        raise RuntimeError(
            f"{type(self).__name__} follows an env from step to step; stored data already hold "
            "what it writes. Append it to a TransformedEnv instead of a replay buffer."
        )

    def _stays_outside(self) -> str | None:
        """Return why it cannot work inside the workers of a batched env."""
        return None

    def _check_batched_worker_compat(self) -> None:
        reason, name = self._stays_outside(), type(self).__name__
        if reason is not None:
            raise RuntimeError(
                f"{name} {reason}; the workers of a SerialEnv or ParallelEnv cannot. Put it "
                f"outside: TransformedEnv(ParallelEnv(n, make_env), {name}(...))."
            )

    def _require(self, written: Iterable[NestedKey], *keys: NestedKey, advice: str = "") -> None:
        """Refuse an env whose specs, of the entries ``written``, lack one that is read."""
        written = list(map(unravel_key, written))
        for key in keys:
            if key not in written:
                raise KeyError(
                    f"{type(self).__name__} reads {key!r}, which the env before it does not "
                    f"write; it writes {sorted(map(str, written))}. "
                    f"{advice or 'Name one of them.'}"
                )


def zero_count(tensordict: TensorDictBase) -> Tensor:
    """Return a count of 0 for each element, int64 ``[*B, 1]``."""
    shape, device = (*tensordict.batch_size, 1), tensordict.device
    return torch.zeros(shape, dtype=torch.int64, device=device)


def count_spec(spec: Composite) -> Unbounded:
    """Return the spec of a count, int64 ``[*B, 1]``."""
    return Unbounded((*spec.shape, 1), dtype=torch.int64, device=spec.device)
