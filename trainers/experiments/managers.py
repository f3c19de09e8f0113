"""A manager that learns: prior and value of the options from the agent's own searches."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_hmcts.objectives import ExpertIterationLoss
from torchrl_hmcts.planners import SearchBudget
from torchrl_hmcts.trainers.experiments.kits import Kit
from torchrl_hmcts.trainers.expert_iteration import ExpertIterationTrainer
from torchrl_hmcts.trainers.saving.checkpoints import plain_checkpoint

_FILE = "manager.torchrl"


def learn_manager(
    kit: Kit,
    simulator: EnvBase,
    *,
    searches: int = 100,
    iterations: int = 2,
    updates: int = 400,
    save_dir: str | Path | None = None,
    resume: bool = False,
    progress: Callable[..., Any] | None = None,
) -> TensorDictModuleBase:
    """Train the network that guides a kit's planner, on searches that it comes to guide.

    Each iteration makes ``searches`` from fresh starts, the first without the network, and updates
    it ``updates`` times.

    Reference:
        Anthony, Tian and Barber, "Thinking fast and slow with deep learning and tree search", 2017,
        arXiv 1705.08439.
    """
    first = kit.make_planner(simulator)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(kit.config.seed)
        network = kit.manager_network(first, "train")
    goal = not kit.replans
    guided = kit.guide(kit.make_planner(simulator), network)
    if kit.learning_options:
        guided.budget = SearchBudget(expansions=kit.learning_options)
    trainer = ExpertIterationTrainer(
        simulator,
        network,
        first,
        planner=guided,
        loss_module=ExpertIterationLoss(network, value_loss="log" if goal else "smooth_l1"),
        iterations=iterations,
        searches_per_iteration=searches,
        updates_per_iteration=updates,
        example_kwargs={"roots": not goal},
        progress=progress,
        save_dir=save_dir,
        seed=kit.config.seed,
    )
    if resume and save_dir is not None:
        with suppress(FileNotFoundError):  # the run was stopped before the first
            trainer.load(save_dir)
    trainer.train()
    return network.eval()


def save_manager(folder: Path, network: TensorDictModuleBase) -> None:
    """Write a manager's network into the folder of a run or an agent."""
    plain_checkpoint(manager=network).save(folder / _FILE)


def load_manager(
    kit: Kit, folder: str | Path, make_simulator: Callable[[], EnvBase]
) -> TensorDictModuleBase | None:
    """Read the network of a run or an agent; None if it has none."""
    path = Path(folder) / _FILE
    if not path.is_file():
        return None
    network = kit.manager_network(kit.make_planner(make_simulator()), "train", scale=False)
    plain_checkpoint(manager=network).load(path)
    return network.eval()
