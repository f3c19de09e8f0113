"""What every test gets: one thread, fixed seeds."""

from __future__ import annotations

import os
import random
import signal

os.environ.setdefault("MPLBACKEND", "Agg")  # before anything imports matplotlib

import hypothesis
import numpy as np
import pytest
import torch

# Numba compiles within the first example, so a deadline would fail it by chance. Derandomised:
# a red test is red again for whoever looks into it.
hypothesis.settings.register_profile("tests", deadline=None, derandomize=True)
hypothesis.settings.load_profile("tests")

# A shell starts what it runs in the background with Ctrl-C ignored; tests send that signal.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Batches are small; the second thread of a two-core machine only makes them wait.
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def fixed_seeds() -> None:
    """Gives each test the same random numbers whatever ran before it."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002  third-party code draws from the global generator
    torch.manual_seed(0)
