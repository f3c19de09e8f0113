"""Random numbers of states, which depend on their place in a tree, not on the trees beside it.

Letters: ``m`` states, ``w`` rollouts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

# Entry with a seed for each state, int64 [m], given to evaluators that draw random numbers.
SEED_KEY = "_seed"


def with_seeds(part: Any, td: TensorDictBase, seeds: Callable[[], np.ndarray]) -> TensorDictBase:
    """Return states with the seeds, where a part draws random numbers."""
    if not getattr(part, "is_random", False):
        return td
    return td.copy().set(SEED_KEY, torch.from_numpy(seeds()))


def wave_seeds(
    seeds: np.ndarray, counted: np.ndarray, nodes: np.ndarray, options: np.ndarray
) -> np.ndarray:
    """Return seeds that depend on root, node, option and order of outcomes, int64 ``[m]``."""
    mixed = seeds.astype(np.uint64) * np.uint64(0xBF58476D1CE4E5B9)
    for part in (nodes, options, counted):
        mixed = (mixed ^ part.astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return (mixed >> np.uint64(1)).astype(np.int64)


def mix(bits: np.ndarray) -> np.ndarray:
    """Hash 64 bits: SplitMix64 of Steele, Lea and Flood, "Fast splittable generators", 2014."""
    bits = bits + np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


def uniform_bits(streams: np.ndarray, step: int) -> np.ndarray:
    """Random bits number ``step`` of each stream, uint64 ``[w]``."""
    return mix(streams + np.uint64(step))
