"""What the server imports that starts a pool's processes, so that each of them starts at once."""

from __future__ import annotations

import contextlib

import numpy as np

from torchrl_hmcts.envs.atari import process  # noqa: F401
from torchrl_hmcts.envs.atari.workers import SharedMLP

with contextlib.suppress(ImportError):
    import ale_py  # noqa: F401

# Loads the compiled network; by itself, a process would need a second for it.
SharedMLP(1, 1, hidden=(1,)).act(np.zeros(128, np.uint8), 0, np.random.default_rng(0))
