"""Datasets of base transitions, from memory or from disk."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer


def load_dataset(
    dataset: ReplayBuffer | TensorDictBase | str | Path | None, keys: Sequence[NestedKey]
) -> TensorDictBase:
    """Return the transitions of a dataset in one batch dimension, mapped from disk if they are."""
    data: TensorDictBase = TensorDict(batch_size=[0])
    if isinstance(dataset, (str, Path)):
        data = _load_folder(Path(dataset))
    elif isinstance(dataset, ReplayBuffer):
        data = dataset[:] if len(dataset) else data
    elif isinstance(dataset, TensorDictBase):
        data = dataset
    elif dataset is not None:
        raise TypeError(
            f"A dataset is a ReplayBuffer, a TensorDict or the path of a folder; got "
            f"{type(dataset).__name__}."
        )
    data = data if data.ndim == 1 else data.reshape(-1)
    if not len(data):
        return TensorDict(batch_size=[0])
    missing = [key for key in keys if data.get(key, None) is None]
    if missing:
        raise ValueError(
            f"The dataset lacks {missing}, which the loss reads; it has "
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


def sample_union(
    buffer: ReplayBuffer,
    *,
    dataset: TensorDictBase,
    batch_size: int,
    fraction: float | None,
    reward: Callable[[TensorDictBase], TensorDictBase],
) -> TensorDictBase:
    """Draw a batch from a replay buffer S and a dataset D together, and write its reward.

    ``fraction`` of it comes from D, while both have some; ``None``: uniformly from the union.
    """
    own, given = len(buffer), len(dataset)
    if own and given and fraction is not None:
        from_given = round(fraction * batch_size)
        given_index = torch.randint(given, (from_given,))
        own_index = torch.randint(own, (batch_size - from_given,))
    else:
        index = torch.randint(own + given, (batch_size,))
        own_index, given_index = index[index < own], index[index >= own] - own
    drawn = ((buffer, own_index), (dataset, given_index))
    parts = [source[rows] for source, rows in drawn if len(rows)]
    return reward(torch.cat(parts) if len(parts) > 1 else parts[0])
