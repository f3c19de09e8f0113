"""``hmcts train kit=ogbench``: learn from recorded episodes, then act in OGBench's five tasks."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.trainers.evaluation import spread
from torchrl_hmcts.trainers.experiments.ogbench.agent import (
    Learned,
    OptionAgent,
    fit_model,
    learn,
    make_agent,
    make_loss,
)
from torchrl_hmcts.trainers.experiments.ogbench.config import FOLDER, OGBenchConfig, split_name
from torchrl_hmcts.trainers.experiments.ogbench.data import load, quiet, record, save
from torchrl_hmcts.trainers.figures.intervals import wilson
from torchrl_hmcts.trainers.runs.console import counted, table
from torchrl_hmcts.trainers.runs.run import open_run
from torchrl_hmcts.trainers.saving.checkpoints import newest_checkpoint, plain_checkpoint
from torchrl_hmcts.trainers.saving.worker_file import load_networks, save_worker

_TASKS = 5


def run_ogbench(config: OGBenchConfig) -> dict[str, Any]:
    """Run ``hmcts train kit=ogbench env.id=NAME``; return its figures.

    Nothing of the simulator's state is read: the agent sees what a step returns.

    Reference:
        Park et al., "OGBench: Benchmarking offline goal-conditioned RL", 2024, arXiv 2410.20092.
    """
    with open_run(config) as run:
        config = run.config.sized()
        torch.set_num_threads(1)
        data = recorded(config)
        model = fit_model(data, config)
        learned = Learned(make_loss(data, config))
        if run.resumes:
            path = newest_checkpoint(run.checkpoints)
            plain_checkpoint(loss_module=learned.loss, training=learned).load(path)
        else:
            learned = learn(data, model, config, progress=counted("learn", "updates"))
            run.checkpoints.mkdir(exist_ok=True)
            path = run.checkpoints / f"checkpoint-{config.num_updates:012d}.torchrl"
            plain_checkpoint(loss_module=learned.loss, training=learned).save(path)
        save_worker(run.path, learned.loss, config.num_updates)
        steps = learned.curves["updates"]
        curves = {k: (steps, values) for k, values in learned.curves.items() if k != "updates"}
        run.write_curves(curves, "updates")
        agent = make_agent(model, learned.loss.actor_network, config)
        episodes = play_tasks(agent, config, progress=counted("act", "episodes"))
        metrics: dict[str, Any] = {
            "seed": config.seed,
            "recorded_steps": len(data),
            "landmarks": model.num_landmarks,
            "options": model.num_options,
            "train_cpu_seconds": round(learned.cpu_seconds, 1),
            "test": summary(episodes),
        }
        with run.finish(metrics, config, title=f"Offline: {config.id}") as pictures:
            from torchrl_hmcts.trainers.figures.maps import plot_ways

            words = "Where options lead (grey; stars: before jumps), and an episode of each task."
            with pictures.one("search.png", words) as path:
                plot_ways(model, [e["places"] for e in episodes[:: config.episodes]], path)
    test = metrics["test"]
    rows = [
        ("episodes solved, mean of five tasks", f"{100 * test['solved']:.1f} %"),
        ("episodes", str(test["episodes"])),
        ("base steps of solved episodes, median", f"{test['steps']['median']:,.0f}"),
        ("CPU seconds per plan, median", f"{test['plan_cpu_seconds']['median']:.3f}"),
    ]
    print(table(rows))
    return metrics


def evaluate_ogbench(config: OGBenchConfig) -> dict[str, Any]:
    """Act again with what a run, whose folder is ``out``, has learned."""
    config = config.sized()
    torch.set_num_threads(1)
    data = recorded(config)
    loss = make_loss(data, config)
    checkpoint = load_networks(loss, config.out)
    agent = make_agent(fit_model(data, config), loss.actor_network, config)
    episodes = play_tasks(agent, config, progress=counted("act", "episodes"))
    return {"checkpoint": checkpoint.name, "test": summary(episodes)}


def recorded(config: OGBenchConfig) -> TensorDictBase:
    """Return the recorded episodes of a run; record them where there are none yet."""
    path = Path(config.data) if config.data else FOLDER / config.id
    if not config.data and not path.exists():
        print(f"Recording {config.id} in {path} ...", flush=True)
        save(record(config.id, progress=counted("record", "episodes")), path)
    return load(path)


@quiet()
def play_tasks(
    agent: OptionAgent,
    config: OGBenchConfig,
    *,
    progress: Callable[[Any], Any] = iter,
) -> list[dict[str, Any]]:
    """Act in every episode of every task; an episode is drawn by its number and the run's seed.

    Returns of each ``task``, ``solved``, ``steps``, ``options``, ``cpu_seconds``, ``plan_seconds``
    (of each option) and ``places`` (``[steps + 1, F]``).
    """
    env = make_gym(split_name(config.id).env)
    numbers = [(task, i) for task in range(1, _TASKS + 1) for i in range(config.episodes)]
    return [
        {"task": task, **act_once(env, agent, task, (config.seed, task, number))}
        for task, number in progress(numbers)
    ]


def act_once(
    env: gymnasium.Env, agent: OptionAgent, task: int, seeds: Sequence[int]
) -> dict[str, Any]:
    """Act in one episode of a task, 1 to 5; start, goal and chance are drawn from ``seeds``."""
    seed = int(np.random.SeedSequence(seeds).generate_state(1)[0])
    env.seed_globals(seed)  # type: ignore[attr-defined]
    begin = time.process_time()
    observation, info = env.reset(seed=seed, options={"task_id": task})
    agent.begin(info["goal"])
    place = agent.config.place
    places, plans, over, info = [observation[place]], [], False, {"success": 0.0}
    while not over:
        options, before = agent.num_options, time.process_time()
        action = agent.act(observation)
        if agent.num_options > options:
            plans.append(time.process_time() - before)
        observation, _, terminated, truncated, info = env.step(action)
        places.append(observation[place])
        over = terminated or truncated
    return {
        "solved": bool(info["success"]),
        "steps": len(places) - 1,
        "options": agent.num_options,
        "cpu_seconds": time.process_time() - begin,
        "plan_seconds": plans,
        "places": np.array(places),
    }


def summary(episodes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of episodes: shares solved with 95 % intervals, steps and seconds."""
    tasks = sorted({e["task"] for e in episodes})
    by_task = [np.mean([e["solved"] for e in episodes if e["task"] == task]) for task in tasks]
    solved = [e for e in episodes if e["solved"]]
    plans = [seconds for e in episodes for seconds in e["plan_seconds"]]
    return {
        "episodes": len(episodes),
        "solved": round(float(np.mean(by_task)), 4),
        "solved_interval": wilson(len(solved), len(episodes)),
        "solved_by_task": [round(float(share), 4) for share in by_task],
        "steps": spread([e["steps"] for e in solved]),
        "options": spread([e["options"] for e in solved]),
        "plan_cpu_seconds": spread(plans),
        "episode_cpu_seconds": spread([e["cpu_seconds"] for e in episodes]),
    }
