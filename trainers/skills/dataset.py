"""Datasets of base transitions, from memory or from disk."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer


def load_dataset(
    dataset: ReplayBuffer | TensorDictBase | str | Path | None, keys: Sequence[NestedKey]
) -> TensorDictBase:
    """Return the transitions of a dataset in one batch dimension, mapped from disk if they are.

    Args:
        dataset: transitions: a ``ReplayBuffer`` (e.g. one of ``torchrl.data.datasets``), a
            TensorDict of any batch shape, or a folder written by ``replay_buffer.dumps(folder)``,
            by ``storage.dumps(folder)`` or by ``tensordict.memmap(folder)``. (In the bare folder of
            a ``LazyMemmapStorage`` nothing says how much of it is filled.) ``None``: none.
        keys: entries that each transition must have; others are left out.

    Returns:
        Transitions ``[n]`` with the ``keys``; ``[0]`` without entries for an empty dataset.

    Raises:
        FileNotFoundError: if the folder holds no dataset.
        ValueError: if an entry is missing.
        TypeError: if it is none of these.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> data = TensorDict(skill=torch.arange(6).view(2, 3), batch_size=[2, 3])
        >>> _ = data.memmap("recorded")
        >>> load_dataset("recorded", ["skill"])["skill"].tolist()
        [0, 1, 2, 3, 4, 5]
    """
    if dataset is None:
        return TensorDict(batch_size=[0])
    if isinstance(dataset, (str, Path)):
        data, name = _load_folder(Path(dataset)), f"in {str(dataset)!r}"
    elif isinstance(dataset, ReplayBuffer):
        data = dataset[:] if len(dataset) else TensorDict(batch_size=[0])
        name = "in the replay buffer"
    elif isinstance(dataset, TensorDictBase):
        data, name = dataset, "given"
    else:
        raise TypeError(
            f"A dataset is a ReplayBuffer, a TensorDict or the path of a folder; got "
            f"{type(dataset).__name__}."
        )
    data = data.reshape(-1) if data.ndim != 1 else data
    if not len(data):
        return TensorDict(batch_size=[0])
    missing = [key for key in keys if data.get(key, None) is None]
    if missing:
        raise ValueError(
            f"The dataset {name} lacks {missing}, which the loss reads; it has "
            f"{sorted(map(str, data.keys(True, True)))}. Record it with "
            "OptionRecorder(loss.in_keys)."
        )
    return data.select(*keys)


def _load_folder(folder: Path) -> TensorDictBase:
    storage = folder / "storage" if (folder / "storage").is_dir() else folder
    if not (storage / "meta.json").is_file():
        raise FileNotFoundError(
            f"There is no dataset in {str(folder)!r}. Write one with replay_buffer.dumps(folder) "
            "or tensordict.memmap(folder)."
        )
    data = TensorDict.load_memmap(storage, allow_pickle=False)
    filled = storage / "storage_metadata.json"
    if filled.is_file():
        data = data[: json.loads(filled.read_text(encoding="utf-8"))["len"]]
    return data


class UnionSampler:
    """Draws batches from a replay buffer S and a dataset D together.

    Args:
        buffer: S, which may grow.
        dataset: D, transitions ``[n]``, maybe none.
        batch_size: transitions of a batch.
        fraction: share of a batch that comes from D, while both have some. ``None``: uniformly from
            the union.
        reward: transform that writes the reward of a batch.

    Example:
        >>> from torchrl.data import LazyTensorStorage
        >>> given = TensorDict(x=torch.arange(3), batch_size=[3])
        >>> buffer = ReplayBuffer(storage=LazyTensorStorage(9))
        >>> UnionSampler(buffer, given, 8, None, torch.nn.Identity()).sample().batch_size
        torch.Size([8])
    """

    def __init__(
        self,
        buffer: ReplayBuffer,
        dataset: TensorDictBase,
        batch_size: int,
        fraction: float | None,
        reward: torch.nn.Module,
    ) -> None:
        self.buffer, self.dataset = buffer, dataset
        self.batch_size, self.fraction, self.reward = batch_size, fraction, reward

    def sample(self, batch: TensorDictBase | None = None) -> TensorDictBase:
        """Return a batch; a ``Trainer`` passes the latest one, which is not used."""
        own, given = len(self.buffer), len(self.dataset)
        if own and given and self.fraction is not None:
            from_given = round(self.fraction * self.batch_size)
            given_index = torch.randint(given, (from_given,))
            own_index = torch.randint(own, (self.batch_size - from_given,))
        else:  # uniform over the union
            index = torch.randint(own + given, (self.batch_size,))
            own_index, given_index = index[index < own], index[index >= own] - own
        parts = [
            source[rows]
            for source, rows in ((self.buffer, own_index), (self.dataset, given_index))
            if len(rows)
        ]
        return self.reward(torch.cat(parts) if len(parts) > 1 else parts[0])
