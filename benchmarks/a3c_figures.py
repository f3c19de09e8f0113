r"""CartPole solved by A3CTrainer, and what a second learner is worth.

    python benchmarks/a3c_figures.py --seeds 0 1 2 --out docs/results/a3c/a3c_figures.json
                                                                       (about 10 minutes on 2 cores)
    python benchmarks/a3c_figures.py --quick                      (half a minute)

CartPole-v1 is trained until the policy, sampled, has a mean return of 475 or more over 100
episodes; seconds are those of ``train()``, with the start of the processes and all evaluations.
The learners' speed is measured in Waterworld, alternately with one and with two of them, for 20 s
from when all are at work. It is a figure of an idle machine.
"""

from __future__ import annotations

import os
import platform
import time
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from table import read_arguments, write
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase, GymWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor, ValueOperator

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.objectives import A3CLoss
from torchrl_hmcts.trainers.a3c.trainer import A3CTrainer

SOLVED, EPISODES = 475.0, 100
COPIES = 16


def make_vector(copies: int) -> SyncVectorEnv:
    """Copies of CartPole-v1 in one process, each reset in the step in which it ends."""
    makers = [partial(gym.make, "CartPole-v1") for _ in range(copies)]
    return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)


def make_cartpole(copies: int) -> EnvBase:
    return GymWrapper(make_vector(copies), categorical_action_encoding=True)


def make_waterworld() -> EnvBase:
    return WaterworldMazeEnv(maze_pool("train"), batch_size=[COPIES])


def make_loss(inputs: int, actions: int, width: int, seed: int, **settings: Any) -> A3CLoss:
    """Actor and critic of two hidden layers each."""
    torch.manual_seed(seed)

    def network(outputs: int, gain: float) -> nn.Module:
        layers: list[nn.Module] = []
        for fan_in, fan_out in ((inputs, width), (width, width), (width, outputs)):
            linear = nn.Linear(fan_in, fan_out)
            nn.init.orthogonal_(linear.weight, gain if fan_out == outputs else 2.0**0.5)
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.Tanh()]
        return nn.Sequential(*layers[:-1])

    actor = ProbabilisticActor(
        TensorDictModule(network(actions, 0.01), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
    )
    return A3CLoss(actor, ValueOperator(network(1, 1.0), in_keys=["observation"]), **settings)


def cartpole_return(policy: TensorDictModuleBase, episodes: int, seed: int) -> float:
    """Mean return of the sampled policy, one episode in each of so many copies."""
    env = make_vector(episodes)
    observation, _ = env.reset(seed=1_000_000 + seed)
    returns, running = np.zeros(episodes), np.ones(episodes, dtype=bool)
    with set_exploration_type(ExplorationType.RANDOM), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        while running.any():
            td = TensorDict(observation=torch.as_tensor(observation), batch_size=[episodes])
            action = policy(td)["action"].numpy()
            observation, reward, terminated, truncated, _ = env.step(action)
            returns += reward * running
            running &= ~(terminated | truncated)
    env.close()
    return float(returns.mean())


def solve_cartpole(seed: int, *, total_frames: int = 1_000_000, **settings: Any) -> dict[str, Any]:
    """Train until CartPole is solved; return when that was."""
    loss = make_loss(4, 2, 64, seed, entropy_coeff=0.01, gamma=0.99)
    trainer = A3CTrainer(
        partial(make_cartpole, 8),
        loss,
        total_frames=total_frames,
        seed=seed,
        evaluate=lambda policy: {"return": cartpole_return(policy, EPISODES, seed)},
        stop_when=lambda metrics: metrics["return"] >= SOLVED,
        **{
            "segment_steps": 16,
            "optimizer": "adam",
            "lr": 2e-3,
            "lr_schedule": "linear",
            "clip_norm": 0.5,
            "eval_interval": 20_000,
            **settings,
        },
    )
    history = trainer.train()
    return {
        "seed": seed,
        "solved": history["eval_return"][-1] >= SOLVED,
        "mean_return": round(history["eval_return"][-1], 1),
        "frames": int(history["eval_frames"][-1]),
        "seconds": round(trainer.seconds, 1),
        "eval_frames": history["eval_frames"],
        "eval_return": history["eval_return"],
    }


def learner_speed(num_learners: int, window_seconds: float, seed: int) -> float:
    """Base steps per second of so many learners together, from when all are at work."""
    marks: list[tuple[float, int]] = []  # time, frames

    def mark(policy: TensorDictModuleBase) -> dict[str, float]:
        if bool((trainer.shared.board[:, 0] > 0).all()):
            marks.append((time.perf_counter(), trainer.frames))
        return {"window": marks[-1][0] - marks[0][0] if marks else 0.0}

    trainer = A3CTrainer(
        make_waterworld,
        make_loss(66, 4, 128, seed),
        total_frames=10**9,
        num_learners=num_learners,
        evaluate=mark,
        eval_interval=1,  # whenever the parent looks, 5 times per second
        stop_when=lambda metrics: metrics["window"] >= window_seconds,
        seed=seed,
    )
    trainer.train()
    (start, before), (end, after) = marks[0], marks[-1]
    return (after - before) / (end - start)


def asynchrony(repeats: int, window_seconds: float) -> dict[str, Any]:
    """Compare one learner with two, in turn, so that a busy machine slows both."""
    maze_pool("train")  # drawn and kept on disk before anything is measured
    speeds: dict[int, list[float]] = {1: [], 2: []}
    for repeat in range(repeats):
        for learners in (1, 2):
            speeds[learners].append(round(learner_speed(learners, window_seconds, repeat), 1))
            print(f"{learners} learner(s): {speeds[learners][-1]:.0f} base steps/s", flush=True)
    ratios = [two / one for one, two in zip(speeds[1], speeds[2], strict=True)]
    return {
        "window_seconds": window_seconds,
        "base_steps_per_second_of_1": speeds[1],
        "base_steps_per_second_of_2": speeds[2],
        "ratio": round(float(np.median(ratios)), 2),
        "ratios": [round(ratio, 2) for ratio in ratios],
    }


def main() -> None:
    args = read_arguments(
        __doc__,
        {"seeds": [0]},
        seeds=[0, 1, 2],
        only=(None, "cartpole or asynchrony"),
        repeats=(5, "of one and two learners in turn"),
    )
    results: dict[str, Any] = {}
    if args.only != "asynchrony":
        frames = {"total_frames": 5_000} if args.quick else {}
        results["cartpole"] = [solve_cartpole(seed, **frames) for seed in args.seeds]
        print(*results["cartpole"], sep="\n")
    if args.only != "cartpole":
        results["asynchrony"] = asynchrony(*((1, 3.0) if args.quick else (args.repeats, 20.0)))
        ratio = results["asynchrony"]["ratio"]
        print(f"two learners: {ratio} times the base steps per second of one (median)")
    seeds = " ".join(map(str, args.seeds))
    results["command"] = f"python benchmarks/a3c_figures.py --seeds {seeds}"
    results["versions"] = {"python": platform.python_version(), "torch": torch.__version__}
    results["cores"] = os.cpu_count()
    write(args, results)


if __name__ == "__main__":
    main()
