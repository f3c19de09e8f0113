"""Imports for the server that starts a pool's processes, so that each of them starts at once."""

from __future__ import annotations

import contextlib

import numpy as np

from torchrl_hmcts.envs import SharedMLP
from torchrl_hmcts.envs.gym import processes  # noqa: F401

with contextlib.suppress(ImportError):
    import ale_py  # noqa: F401

# Loads the compiled network; by itself, a process would need a second for it.
SharedMLP(1, 1, hidden=(1,)).act(np.zeros(128, np.uint8), 0, np.random.default_rng(0))
