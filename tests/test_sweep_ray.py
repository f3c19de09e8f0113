"""Collecting in a process of a Ray cluster."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torchrl.collectors import Collector

from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env


class Elsewhere:
    """A collector that is no ``Collector``: it has weights of its own, which must be sent."""

    def __init__(self, *args, **kwargs) -> None:
        self.inner = Collector(*args, **kwargs)
        self.sent = 0

    def update_policy_weights_(self, *args, **kwargs) -> None:
        self.sent += 1

    def __getattr__(self, name: str):
        return getattr(self.inner, name)

    def __iter__(self):
        return iter(self.inner)


def test_weights_are_sent_to_a_collector_elsewhere_after_every_batch() -> None:
    env = make_training_env(copies=8)
    loss = DIAYNTrainer.make_loss(env, seed=0)
    made = []

    def make_collector(*args, **kwargs) -> Elsewhere:
        made.append(Elsewhere(*args, **kwargs))
        return made[0]

    trainer = DIAYNTrainer(
        env, loss, total_frames=96, frames_per_batch=32, seed=0, make_collector=make_collector
    )
    trainer.train()
    assert trainer.collected_frames == 96
    assert made[0].sent == 3


def test_algorithm_3_does_not_go_with_ray(capsys) -> None:
    assert main(["train", "experiment=labmaze", "algorithm=hmcts", "collector=ray"]) == 2
    assert "collector='ray' goes with algorithm='diayn'; got 'hmcts'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_worker_is_trained_with_a_local_ray_cluster(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    words = ["experiment=labmaze", "toy=true", "collector=ray", f"out={tmp_path / 'run'}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "RAY_AUTH_MODE": "disabled"}
    environment.pop("RAY_ADDRESS", None)
    done = subprocess.run(
        [sys.executable, "-m", "torchrl_hmcts.trainers.cli", "train", *words],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["training_base_steps"] == 1_024
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["config"]["collector"] == "ray"
    # The worker has learned something from what came back.
    from torchrl_hmcts.trainers.experiments.kits.lab import LabMazeKit
    from torchrl_hmcts.trainers.experiments.settings import LabMazeConfig
    from torchrl_hmcts.trainers.experiments.skills import make_loss
    from torchrl_hmcts.trainers.saving.worker_file import load_networks

    before, after = (make_loss(LabMazeKit(LabMazeConfig())) for _ in range(2))
    load_networks(after, tmp_path / "run")
    pairs = zip(before.parameters(), after.parameters(), strict=True)
    assert any(not torch.equal(a, b) for a, b in pairs)
