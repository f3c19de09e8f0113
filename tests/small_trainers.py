"""Trainers that take a moment, a bar that remembers, and a comparison to the bit, for tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import ProbabilisticActor, ValueOperator

from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.objectives import A3CLoss
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers import A3CTrainer, DIAYNTrainer
from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform


def make_diayn(folder: Path | None, total: int = 48, hidden: int = 8, **other: Any) -> DIAYNTrainer:
    """Four skills in eight mazes, in batches of 16 base steps."""
    torch.manual_seed(1)
    base = WaterworldMazeEnv(batch_size=[8], observation=False, max_steps=10)
    env = TransformedEnv(base, Compose(SkillTransform(4, 5, seed=3), DisplacementTransform()))
    loss = DIAYNTrainer.make_loss(env, 4, hidden=(hidden,), seed=0)
    sizes = {"frames_per_batch": 16, "batch_size": 8, "buffer_size": 64, "seed": 5, **other}
    return DIAYNTrainer(env, loss, total_frames=total, save_dir=folder, **sizes)


def make_a3c(folder: Path, total: int = 800, length: int = 4, **other: Any) -> A3CTrainer:
    """One learner in this process, in a chain."""
    return A3CTrainer(
        partial(ChainEnv, length=length, batch_size=[8]),
        A3CLoss(*make_networks(length, seed=1), gamma=0.9),
        total_frames=total,
        segment_steps=5,
        num_learners=0,
        save_dir=folder,
        **other,
    )


def make_networks(length: int, seed: int = 0) -> tuple[ProbabilisticActor, ValueOperator]:
    """Actor and critic of a chain, a weight for each of its states."""
    torch.manual_seed(seed)
    actor = ProbabilisticActor(
        TensorDictModule(torch.nn.Embedding(length, 2), ["state"], ["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
    )
    return actor, ValueOperator(torch.nn.Embedding(length, 1), in_keys=["state"])


class Bar:
    """A progress bar that remembers what it was told."""

    def __init__(self, total: int) -> None:
        self.total, self.n, self.closed = total, 0, False
        self.moves: list[int] = []
        self.figures: dict[str, str] = {}

    def update(self, n: int) -> None:
        self.n += n
        self.moves.append(n)

    def set_postfix(self, values: Mapping[str, str] | None = None, **figures: Any) -> None:
        figures.pop("refresh", None)
        self.figures = {**(values or {}), **figures}

    def close(self) -> None:
        self.closed = True


class Bars(list[Bar]):
    """Makes progress bars, and keeps them."""

    def __call__(self, total: int) -> Bar:
        self.append(Bar(total))
        return self[-1]


def weights(trainer: Any) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in trainer.loss_module.parameters()]).clone()


def differences(a: Any, b: Any, path: str = "") -> list[str]:
    """Returns the paths at which two nested structures differ in any bit."""
    if isinstance(a, torch.Tensor):
        same = a.dtype == b.dtype and torch.equal(a, b)
        return [] if same else [path]
    if isinstance(a, Mapping):
        if list(a) != list(b):
            return [f"{path}: {sorted(map(str, a))} and {sorted(map(str, b))}"]
        return [d for key in a for d in differences(a[key], b[key], f"{path}.{key}")]
    if isinstance(a, Sequence) and not isinstance(a, str):
        if len(a) != len(b):
            return [f"{path}: {len(a)} and {len(b)}"]
        return [d for i in range(len(a)) for d in differences(a[i], b[i], f"{path}.{i}")]
    return [] if a == b else [f"{path}: {a} and {b}"]
