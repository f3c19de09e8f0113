"""Chapter 3: A3C in Waterworld's mazes, with goals that a tree search sets or without."""

from __future__ import annotations

import dataclasses
import json
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.objectives import A3CLoss
from torchrl_hmcts.trainers.a3c.trainer import A3CTrainer
from torchrl_hmcts.trainers.experiments.demo import make_starts
from torchrl_hmcts.trainers.experiments.waterworld.agents import (
    MazeTest,
    make_maze_networks,
    play_mazes,
)
from torchrl_hmcts.trainers.experiments.waterworld.config import (
    WaterworldA3CConfig,
    WaterworldGoalsConfig,
)
from torchrl_hmcts.trainers.experiments.waterworld.goal_episodes import run_goal_episodes
from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import (
    make_goal_env,
    make_tile_planner,
)
from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.runs.loggers import make_logger
from torchrl_hmcts.trainers.runs.run import Run, open_run
from torchrl_hmcts.trainers.runs.worker_file import save_worker
from torchrl_hmcts.trainers.saving.files import left_out, write_csv
from torchrl_hmcts.trainers.saving.run_folder import versions

_GOAL_KEYS = (
    "num_goals",
    "goal_met_threshold",
    "goal_divergence_threshold",
    "r_tick",
    "r_goal_met",
    "r_goal_divergence",
)
TOY: dict[str, Any] = {
    "total_frames": 4_000,
    "num_learners": 0,
    "test_mazes": 3,
    "eval_mazes": 3,
    "eval_interval": 2_000,
    "max_episode_steps": 100,
}


def make_agent_env(
    config: WaterworldA3CConfig, mazes: Tensor | None = None, batch_size: tuple[int, ...] = ()
) -> EnvBase:
    """Build Waterworld as the agent of an experiment meets it.

    Args:
        config: of the agent with goals or of the one without.
        mazes: bool ``[M, H, W]``. Default: the training split.
        batch_size: of the env.

    Returns:
        The env; with goals, that of :func:`make_goal_env`.
    """
    arguments: dict[str, Any] = {"max_steps": config.max_episode_steps, "batch_size": batch_size}
    if isinstance(config, WaterworldGoalsConfig):
        arguments.update({name: getattr(config, name) for name in _GOAL_KEYS})
        return make_goal_env(mazes, **arguments)
    return WaterworldMazeEnv(mazes, **arguments)


def make_agent_loss(config: WaterworldA3CConfig) -> A3CLoss:
    """Build actor, critic and loss; the agents with and without goals differ in one input.

    Args:
        config: of the experiment.
    """
    env = make_agent_env(config)
    in_keys = ["observation", "velocity"]
    if isinstance(config, WaterworldGoalsConfig):
        in_keys.append("goals")
    actor, critic = make_maze_networks(env, in_keys=in_keys, hidden=config.hidden, seed=config.seed)
    return A3CLoss(
        actor,
        critic,
        entropy_coeff=config.entropy_coeff,
        critic_coeff=config.critic_coeff,
        gamma=config.gamma,
    )


def run_waterworld(config: WaterworldA3CConfig) -> dict[str, Any]:
    """Run ``hmcts train experiment=waterworld_goals`` or ``waterworld_a3c``; return its metrics.

    Args:
        config: says which by its class.

    Returns:
        The metrics, as written to ``metrics.json``. Times are in seconds, steps in base steps.

    Reference:
        Dissertation, chapter 3.
    """
    with open_run(config) as run:
        return _run_waterworld(run.config, run)


def _run_waterworld(config: WaterworldA3CConfig, run: Run) -> dict[str, Any]:
    """Carry the experiment out in a folder that is open."""
    if config.toy:
        config = dataclasses.replace(config, **TOY)
    torch.set_num_threads(1)  # the networks are small: threads would only get in each other's way
    out = run.path
    with_goals = isinstance(config, WaterworldGoalsConfig)
    tests = make_agent_env(config, maze_pool("test"))
    starts = make_starts(tests.base_env if with_goals else tests, config.test_mazes, config.seed)
    loss = make_agent_loss(config)

    def evaluate(policy: TensorDictModuleBase) -> dict[str, float]:
        test = play_mazes(policy, tests, starts[: config.eval_mazes], seed=config.seed)
        return {
            "solved_share": float(test.solved.double().mean()),
            "episode_steps": float(test.base_steps.double().mean()),
        }

    logger = make_logger(config)
    trainer = A3CTrainer(
        partial(make_agent_env, config, None, (config.envs_per_learner,)),
        loss,
        total_frames=config.total_frames,
        segment_steps=config.segment_steps,
        num_learners=config.num_learners,
        lr=config.learning_rate,
        clip_norm=config.clip_norm,
        evaluate=evaluate,
        eval_interval=config.eval_interval,
        logger=logger,
        save_dir=run.checkpoints,
        progress=lambda total: tqdm(total=total, desc="train", unit="step", disable=None),
        seed=config.seed,
    )
    kept = [key for key in config.KEPT if key != "toy"]
    trainer.run_settings.update({name: getattr(config, name) for name in kept})
    if run.resumes:
        trainer.load(run.checkpoints)
    name = "the worker of the goal-based agent" if with_goals else "A3C without goals"
    print(f"Training {name}, {config.total_frames:,} base steps ...", flush=True)
    begin = time.perf_counter()
    history = trainer.train()
    train_seconds = time.perf_counter() - begin
    logger.close()
    save_worker(out, loss, trainer.frames)
    with left_out("curves.csv"):
        write_curves(history, out / "curves.csv")

    print(f"Testing in {config.test_mazes} mazes it has never seen ...", flush=True)
    policy = loss.actor_network
    sampled = play_mazes(policy, tests, starts, seed=config.seed)
    greedy = play_mazes(policy, tests, starts, deterministic=True)
    metrics: dict[str, Any] = {
        "seed": config.seed,
        "train_base_steps": int(history["frames"][-1]),
        "train_seconds": round(train_seconds, 1),
        "test": sampled.summary(),
        "test_greedy": greedy.summary(),
    }
    if with_goals:
        for key in ("num_plans", "num_goals_met", "num_divergences"):
            metrics["test"][f"{key}_mean"] = round(float(sampled.last[key].double().mean()), 3)
    metrics["config"] = dataclasses.asdict(config)
    metrics["versions"] = versions()
    with run.finish(metrics, title=f"Random mazes: {name}") as pictures:
        words = "Test mazes solved and base steps of an episode while it learns."
        with pictures.one("learning.png", words) as path:
            from torchrl_hmcts.trainers.figures.curves import learning_panels, plot_training

            plot_training(
                {name: [learning_curve(history)]},
                learning_panels(config.max_episode_steps),
                path,
                title=f"{name[0].upper()}{name[1:]}, seed {config.seed}",
            )
        if with_goals:
            draw_episode(policy, tests, starts, greedy, pictures)
    print(json.dumps({k: metrics[k] for k in ("train_seconds", "test", "test_greedy")}, indent=1))
    return metrics


def draw_episode(
    policy: TensorDictModuleBase,
    env: EnvBase,
    starts: TensorDictBase,
    test: MazeTest,
    pictures: Pictures,
) -> None:
    """Draw a rather long episode of the goal-based agent: Figure 3.5, the search, and a GIF.

    Args:
        policy: the worker; it takes its most probable actions.
        env: of :func:`make_agent_env`, with goals.
        starts: states ``[S]``.
        test: what it did from them; an episode that was solved is drawn if there is one.
        pictures: of the run.
    """
    among = torch.nonzero(test.solved).flatten() if test.solved.any() else torch.arange(len(starts))
    by_length = among[test.base_steps[among].argsort(stable=True)]
    index = int(by_length[int(0.85 * (len(by_length) - 1))])
    start = starts[index]
    track = run_goal_episodes(env, policy, starts[index : index + 1], record=True).tracks[0]
    words = "A test maze: the player (blue) on its way along the goals (red) to the target (green)."
    if not track.solved:
        steps = len(track.positions) - 1
        words = words.replace("maze", f"maze that was NOT solved in {steps} base steps")
    with pictures.one("episode.gif", words) as path:
        from torchrl_hmcts.trainers.figures.goals import write_goal_gif

        write_goal_gif(env.base_env, start, track, path)
    words = "The same episode: the manager's goals, half way, and at the end."
    with pictures.one("goals.png", words) as path:
        from torchrl_hmcts.trainers.figures.goals import plot_goals

        plot_goals(env.base_env, start, track, path)
    words = "The manager's tree over tiles, and the path it found."
    with pictures.one("search.png", words) as path:
        from torchrl_hmcts.trainers.figures.goals import plot_tile_search

        manager = make_tile_planner(env.base_env)
        goals, lengths = manager.plan_goals(start[None])
        search = manager.planner.last_search
        assert search is not None
        plot_tile_search(env.base_env, start, search, goals[0, : int(lengths[0])], path)


def learning_curve(history: dict[str, list[float]]) -> dict[str, list[float]]:
    """Return the test curve of a training, with the names of its panels.

    Args:
        history: of an :class:`A3CTrainer` that evaluated.
    """
    return {
        "training_steps": history["eval_frames"],
        "solved_share": history["eval_solved_share"],
        "episode_steps": history["eval_episode_steps"],
    }


def write_curves(history: dict[str, list[float]], path: Path) -> None:
    """Write the curves of a training as CSV, one row per value: name, frames, value.

    Args:
        history: of an :class:`A3CTrainer`.
        path: file to write.
    """
    rows: list[tuple[str, int, float]] = []
    for name, values in history.items():
        frames = history["eval_frames" if name.startswith("eval_") else "frames"]
        rows += [(name, int(t), v) for t, v in zip(frames, values, strict=True)]
    write_csv(path, ("name", "frames", "value"), rows)
