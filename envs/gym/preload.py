"""Imports for the server that starts a pool's processes, so that each of them starts at once."""

from __future__ import annotations

import contextlib

import numpy as np

from torchrl_hmcts.envs.gym import processes  # noqa: F401
from torchrl_hmcts.envs.gym.shared_network import SharedNetwork, choose

with contextlib.suppress(ImportError):
    import ale_py  # noqa: F401

# Loads the compiled network; by itself, a process would need a second for it.
net = SharedNetwork(1, 1, 1, [1])
for x in (np.zeros(1, np.uint8), np.zeros(1, np.float32)):
    choose(x, net._array, net._sizes, net._heads[0], net._logits, 0.5, 255.0)
