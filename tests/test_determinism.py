"""The same seed gives the same figures: search and training, with one torch thread and with two.

Train 2 n = train n, load in a new process, train n: here for Atari (``python
tests/test_determinism.py FOLDER`` is the new process); elsewhere for DIAYN
(test_trainer_resume.py), Algorithm 3 (test_hmcts_trainer.py) and expert iteration
(test_expert_iteration.py). The demo's figures: test_demo.py; A3C's learner: test_a3c_trainer.py.
The demo and the experiments set one thread themselves.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from torchrl_hmcts.envs import GridworldMazeEnv, WaterworldMazeEnv
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    DirichletNoise,
    Gumbel,
    MCTSPlanner,
    RadiusNovelty,
    SampledVisits,
    SearchBudget,
)
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_training_env
from torchrl_hmcts.trainers.hmcts import HMCTSTrainer
from torchrl_hmcts.transforms import OptionTransform


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    yield torch.set_num_threads
    torch.set_num_threads(1)


def train_diayn() -> dict[str, Any]:
    env = make_training_env(copies=32)
    loss = DIAYNTrainer.make_loss(env, 4, seed=0)
    trainer = DIAYNTrainer(env, loss, total_frames=192, seed=0)
    trainer.train()
    return {**loss.state_dict(), **trainer.history}


def train_hmcts() -> dict[str, Any]:
    loss = DIAYNTrainer.make_loss(make_training_env(), 4, seed=0)
    trainer = HMCTSTrainer(
        partial(WaterworldMazeEnv, observation=False),
        loss,
        rounds=6,
        num_init_samples=4,
        retrain_interval=2,
        option_steps=10,
        make_planner=partial(
            MCTSPlanner,
            novelty=RadiusNovelty("position", 0.5),
            budget=SearchBudget(expansions=3),
        ),
        seed=0,
    )
    trainer.train()
    return {**loss.state_dict(), **trainer.records.columns}


def search_options() -> dict[str, Any]:
    """A search over options of a random worker, from four starts at once."""
    env = make_training_env(copies=1)
    loss = DIAYNTrainer.make_loss(env, 4, seed=0)
    options = OptionTransform(SkillPolicy(loss.actor_network, deterministic=True), 4, 10)
    macro = TransformedEnv(WaterworldMazeEnv(observation=False), Compose(options))
    macro.set_seed(0)
    starts = macro.reset(TensorDict(batch_size=[4]))
    planner = MCTSPlanner(
        macro, novelty=RadiusNovelty("position", 0.5), budget=SearchBudget(expansions=40)
    )
    return arrays(planner.search(starts, seed=0))


def search_maze(**kwargs: Any) -> dict[str, Any]:
    env = GridworldMazeEnv()
    env.set_seed(0)
    start = env.reset(TensorDict(batch_size=[3]))
    planner = MCTSPlanner(env, **{"budget": SearchBudget(expansions=60), **kwargs})
    found = arrays(planner.search(start, seed=4))
    plans = planner.plan(start)
    return {**found, "options": plans.options, "lengths": plans.lengths}


def arrays(search: Any) -> dict[str, Any]:
    tree = search.tree
    used = int(tree.num_nodes.max())
    assert used > 20
    return {
        "nodes": tree.nodes[:, :used].copy(),
        "edges": tree.edges[:, :used].copy(),
        "roots": tree.roots.copy(),
        "steps": search.num_base_steps.copy(),
    }


def same(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """Returns the names of what differs in any bit."""
    assert list(a) == list(b)
    return [n for n in a if np.asarray(a[n]).tobytes() != np.asarray(b[n]).tobytes()]


HAS_ATARI = importlib.util.find_spec("ale_py") is not None
needs_atari = pytest.mark.skipif(not HAS_ATARI, reason="the games come with ale-py")


def make_atari_run(frames: int, **settings: Any) -> Any:
    """Skills learned on the RAM, and a search over them; without processes of its own."""
    from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig
    from torchrl_hmcts.trainers.experiments.atari.episodes import AtariRun

    tiny = {"source": "diayn", "num_skills": 2, "skill_base_steps": 320, "option_steps": 10}
    tiny.update(ratio=3.0, max_episode_frames=600, replant_every=5, num_processes=0, seed=4)
    return AtariRun(AtariConfig(frames=frames, **{**tiny, **settings}))


def play_atari(run: Any, stop_after: int = 0) -> dict[str, Any]:
    """Plays to the end, or to a checkpoint; returns its state but for the times."""
    saved: list[dict[str, Any]] = []

    def save() -> None:
        saved.append(run.state_dict())
        if len(saved) == stop_after:
            raise KeyboardInterrupt

    if stop_after:
        with pytest.raises(KeyboardInterrupt):
            run.play(save, lambda: None)
    else:
        run.play(save, lambda: None)
    run.close()
    return {key: value for key, value in saved[-1].items() if key != "seconds"}


def flat(state: Any, path: str = "") -> dict[str, Any]:
    """The leaves of nested dicts and lists by their paths."""
    if isinstance(state, Mapping):
        return {k: v for key in state for k, v in flat(state[key], f"{path}.{key}").items()}
    if isinstance(state, (list, tuple)):
        return {k: v for i, x in enumerate(state) for k, v in flat(x, f"{path}.{i}").items()}
    return {path: np.asarray(state) if not isinstance(state, (str, type(None))) else str(state)}


@pytest.mark.parametrize("run", [train_diayn, train_hmcts, search_options])
def test_one_thread_and_two_give_the_same_bits(
    run: Callable[[], dict[str, Any]], threads: Callable[[int], None]
) -> None:
    results = []
    for number in (1, 2):
        threads(number)
        torch.rand(number)  # what was drawn before does not matter
        results.append(run())
    assert same(*results) == []


@pytest.mark.parametrize(
    "parts",
    [
        {"tree_policy": UCT(c=1.0)},
        {"tree_policy": PUCT(), "root_noise": DirichletNoise(0.3)},
        {
            "tree_policy": Gumbel(),
            "expand": "one",
            "budget": SearchBudget(simulations=64, until_plan=False),
        },
        {"final_choice": SampledVisits(temperature=1.0)},
        {"leaves_per_wave": 4},
    ],
    ids=lambda parts: "+".join(parts),
)
def test_a_search_is_a_function_of_its_seed(parts: dict[str, Any]) -> None:
    one = search_maze(**parts)
    torch.rand(7)
    assert same(one, search_maze(**parts)) == []


ATARI_FRAMES = 7_000  # two episodes


@needs_atari
def test_an_atari_run_stopped_and_loaded_in_a_new_process_is_the_run_that_never_stopped(
    tmp_path: Path,
) -> None:
    whole = play_atari(make_atari_run(ATARI_FRAMES))
    half = play_atari(make_atari_run(ATARI_FRAMES), stop_after=3)
    assert len(half["scores"]) < len(whole["scores"])
    torch.save({**half, "seconds": 0.0}, tmp_path / "half.pt")
    subprocess.run([sys.executable, __file__, str(tmp_path)], check=True, timeout=300)
    resumed = torch.load(tmp_path / "resumed.pt", weights_only=True)
    assert same(flat(resumed), flat(whole)) == []


def go_on_with_atari(folder: Path) -> None:
    run = make_atari_run(ATARI_FRAMES)
    run.load_state_dict(torch.load(folder / "half.pt", weights_only=True))
    torch.save(play_atari(run), folder / "resumed.pt")


if __name__ == "__main__":
    torch.set_num_threads(1)
    go_on_with_atari(Path(sys.argv[1]))
