"""Ant mazes of OGBench: who records their episodes, and what their worker sees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("ogbench")

from torchrl_hmcts.trainers import HMCTS
from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments.ogbench.agent import make_loss
from torchrl_hmcts.trainers.experiments.ogbench.ants import AntWalker
from torchrl_hmcts.trainers.experiments.ogbench.config import OGBenchConfig
from torchrl_hmcts.trainers.experiments.ogbench.data import load
from torchrl_hmcts.trainers.experiments.skills import make_loss as skill_loss
from torchrl_hmcts.trainers.saving.worker_file import save_worker

NAME = "antmaze-medium-stitch-v0"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A worker that was not trained: its actions are some function of body and skill."""
    path = tmp_path_factory.mktemp("ant")
    agent = HMCTS("antmaze-medium-v0", kit="ant", options="learned", seed=0)
    save_worker(path, skill_loss(agent.kit), 0)
    return path


def turned(seen: np.ndarray, angle: float) -> np.ndarray:
    """The same ant in a world that is turned about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    out = seen.copy()
    out[:2], out[15:17] = turn @ seen[:2], turn @ seen[15:17]
    w, x, y, z = seen[3:7]
    half_c, half_s = np.cos(angle / 2), np.sin(angle / 2)
    out[3:7] = (
        half_c * w - half_s * z,
        half_c * x - half_s * y,
        half_c * y + half_s * x,
        half_c * z + half_s * w,
    )
    return out


def a_state(seed: int) -> np.ndarray:
    seen = np.random.default_rng(seed).normal(size=29)
    seen[3:7] /= np.linalg.norm(seen[3:7])
    return seen


@pytest.mark.parametrize("angle", [0.3, 2.0, -1.1])
def test_the_plane_has_no_north_for_the_walker_and_the_worker(folder: Path, angle: float) -> None:
    walker, seen = AntWalker(folder), a_state(0)
    way = np.array([0.6, 0.8, 0.0])
    after = turned(np.concatenate([way, seen[3:]]), angle)[:2]
    assert np.allclose(walker(seen, way[:2]), walker(turned(seen, angle), after), atol=1e-5)
    data = TensorDict(
        observation=torch.from_numpy(np.stack([a_state(i) for i in range(50)])),
        action=torch.zeros(50, 8),
        batch_size=[50],
    )
    worker = make_loss(data, OGBenchConfig(id=NAME)).actor_network
    goal = np.concatenate([seen[:2] + [1.0, 2.0], seen[2:]])
    actions = [
        worker(
            TensorDict(
                observation=torch.from_numpy(state).float(), goal=torch.from_numpy(aim[:2]).float()
            )
        )["action"]
        for state, aim in ((seen, goal), (turned(seen, angle), turned(goal, angle)))
    ]
    assert torch.allclose(*actions, atol=1e-4)


def test_episodes_of_ants_are_recorded_by_a_walker(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "data"
    words = ["data", f"id={NAME}", f"out={out}", "episodes=2"]
    assert main(words) == 2
    assert "hmcts train kit=ant" in capsys.readouterr().err
    assert not out.exists()
    assert main(["train", "kit=ogbench", f"env.id={NAME}", f"out={tmp_path / 'run'}"]) == 1
    assert "hmcts data id=antmaze-medium-stitch-v0 walker=DIR" in capsys.readouterr().err
    assert main([*words, f"walker={folder}"]) == 0
    data = load(out)
    assert data["observation"].shape == (2 * 201, 29)
    assert data["action"].shape == (2 * 201, 8)
    assert float(data["action"].abs().max()) <= 1.0
