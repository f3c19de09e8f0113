"""Tests of a run's newest checkpoint, made after the run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import CheckpointError
from torchrl.objectives import LossModule

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.evaluation import plan_and_execute
from torchrl_hmcts.trainers.experiments.demo import make_starts
from torchrl_hmcts.trainers.experiments.lab.config import LabMazeConfig
from torchrl_hmcts.trainers.experiments.lab.evaluation import (
    solve_mazes,
    solve_with_wrong_model,
    wrong_models,
)
from torchrl_hmcts.trainers.experiments.lab.worker import make_worker_loss
from torchrl_hmcts.trainers.experiments.waterworld.agents import play_mazes
from torchrl_hmcts.trainers.experiments.waterworld.config import (
    WaterworldA3CConfig,
    WaterworldGoalsConfig,
)
from torchrl_hmcts.trainers.experiments.waterworld.run import make_agent_env, make_agent_loss
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_option_env, make_training_env
from torchrl_hmcts.trainers.runs.config import DemoConfig
from torchrl_hmcts.trainers.runs.worker_file import find_worker
from torchrl_hmcts.trainers.saving.checkpoints import plain_checkpoint


def load_networks(loss_module: LossModule, run: str | Path) -> Path:
    """Give a loss's networks the weights of a run's worker, and nothing else of it.

    That is the worker whose figures its page shows, or of a run that has not finished, its newest
    checkpoint.

    Args:
        loss_module: built as in the run; changed in place.
        run: the run's folder.

    Returns:
        The file they are from.

    Raises:
        FileNotFoundError: if the run has written none yet.
        ValueError: if the networks are other ones.
    """
    path = find_worker(run)
    try:
        plain_checkpoint(loss_module=loss_module).load(path)
    except CheckpointError as error:
        raise ValueError(
            f"The networks of {path} are not those of this configuration. Leave the keys that "
            f"shape them (num_skills, hidden, ...) as they were. {error}"
        ) from None
    return path


def evaluate_demo(config: DemoConfig) -> dict[str, Any]:
    """Solve test mazes with the worker of a demo.

    Args:
        config: of the demo, whose folder is ``out``; changed keys (``seed``, ``mazes``,
            ``option_steps``, ``novelty_radius``, ``expansions``, ...) change the test.

    Returns:
        Figures of plans that are carried out open-loop, one trial per maze (``"test"``).
    """
    torch.set_num_threads(1)
    env = make_training_env(num_skills=config.num_skills, skill_steps=config.skill_steps)
    loss = DIAYNTrainer.make_loss(env, config.num_skills, seed=config.seed)
    checkpoint = load_networks(loss, config.out)
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    simulator, real = (
        make_option_env(
            worker,
            maze_pool("test"),
            num_skills=config.num_skills,
            option_steps=config.option_steps,
            gamma=config.gamma,
        )
        for _ in range(2)
    )
    planner = MCTSPlanner(
        simulator,
        novelty=RadiusNovelty("position", config.novelty_radius),
        budget=SearchBudget(expansions=config.expansions),
        leaves_per_wave=config.leaves_per_wave,
    )
    mazes = min(3, config.mazes) if config.toy else config.mazes
    starts = make_starts(real.base_env, mazes, config.seed)
    return {
        "checkpoint": checkpoint.name,
        "test": plan_and_execute(planner, real, starts).summary(),
    }


def evaluate_waterworld(config: WaterworldA3CConfig) -> dict[str, Any]:
    """Test the agent of a run of chapter 3 in test mazes, with the starts of ``config.seed``.

    Args:
        config: of the run, whose folder is ``out``; changed keys change the test.

    Returns:
        Figures with sampled actions (``"test"``) and with the most probable ones
        (``"test_greedy"``).

    Reference:
        Dissertation, figure 3.6.
    """
    if config.toy:
        from torchrl_hmcts.trainers.experiments.waterworld.run import TOY

        config = dataclasses.replace(config, **TOY)
    torch.set_num_threads(1)
    loss = make_agent_loss(config)
    checkpoint = load_networks(loss, config.out)
    with_goals = isinstance(config, WaterworldGoalsConfig)
    env = make_agent_env(config, maze_pool("test"))
    starts = make_starts(env.base_env if with_goals else env, config.test_mazes, config.seed)
    policy = loss.actor_network
    return {
        "checkpoint": checkpoint.name,
        "test": play_mazes(policy, env, starts, seed=config.seed).summary(),
        "test_greedy": play_mazes(policy, env, starts, deterministic=True).summary(),
    }


def evaluate_labmaze(config: LabMazeConfig) -> dict[str, Any]:
    """Solve test mazes with the worker of a run of chapter 4.

    Args:
        config: of the run, whose folder is ``out``; changed keys (``mazes``, ``size``, ``seed``,
            ``stall_steps``, ``robust_error``, ...) change the test.

    Returns:
        Figures with the right model (``"test"``) and with wrong ones (``"wrong_model"``).

    Reference:
        Dissertation, figure 4.10.
    """
    if config.toy:
        from torchrl_hmcts.trainers.experiments.lab.run import TOY

        config = dataclasses.replace(config, **TOY)
    torch.set_num_threads(1)
    loss = make_worker_loss(config.num_skills, seed=config.seed)
    checkpoint = load_networks(loss, config.out)
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    robust = list(wrong_models(config.robust_error).items())[:2]
    return {
        "checkpoint": checkpoint.name,
        "test": solve_mazes(config, worker),
        "wrong_model": {
            name: solve_with_wrong_model(
                config, worker, mazes=min(config.mazes, config.robust_mazes), **real
            )
            for name, real in robust
        },
    }
