"""Stable-Baselines3's A2C and PPO on the same mazes, with the budget of chapter 3's agents.

    python benchmarks/stable_baselines.py --seeds 0 --out FILE.json

They play the env that Gymnasium knows as torchrl_hmcts/WaterworldMaze-v0 (observation: player,
target, walls) with the velocity beside it, 16 copies, and the hyperparameters with which
Stable-Baselines3 comes. Tested like our agents: one episode in each of 342 test mazes, actions
sampled. Needs `pip install stable-baselines3`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from torchrl_hmcts.envs import TorchRLGymnasiumEnv, WaterworldMazeEnv, maze_pool
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_starts

ALGORITHMS = {"A2C": A2C, "PPO": PPO}


class WithVelocity(gymnasium.ObservationWrapper):
    """Puts the velocity, which our agents see too, beside the observation; numbers around one."""

    def __init__(self, env: TorchRLGymnasiumEnv) -> None:
        super().__init__(env)
        size = env.observation_space.shape[0] + 2
        self.observation_space = gymnasium.spaces.Box(-2.0, 2.0, (size,), np.float32)

    def reset(self, **kwargs: Any) -> Any:
        observation, info = self.env.reset(**kwargs)
        return self.join(observation, info), info

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(int(action))
        return self.join(observation, info), reward, terminated, truncated, info

    @staticmethod
    def join(observation: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        return np.concatenate((observation / 4.5 - 1.0, info["velocity"] / 2.0)).astype(np.float32)


def make_env(seed: int) -> WithVelocity:
    return WithVelocity(TorchRLGymnasiumEnv(WaterworldMazeEnv(seed=seed)))


def test(model: Any, seed: int, mazes: int) -> dict[str, Any]:
    """One episode in each of the test mazes, all side by side."""
    env = WaterworldMazeEnv(maze_pool("test"))
    state = make_starts(env, mazes, seed)
    steps = np.zeros(mazes, np.int64)
    solved = np.zeros(mazes, np.bool_)
    running = np.arange(mazes)
    while len(running):
        observation = np.concatenate(
            (state["observation"].numpy() / 4.5 - 1.0, state["velocity"].numpy() / 2.0), -1
        ).astype(np.float32)
        action, _ = model.predict(observation, deterministic=False)
        after = env.step(state.set("action", torch.as_tensor(action)))["next"]
        steps[running] += 1
        done = after["done"].squeeze(-1).numpy()
        solved[running] = after["terminated"].squeeze(-1).numpy()
        running, state = running[~done], after[torch.from_numpy(~done)]
    return {
        "mazes": mazes,
        "solved": int(solved.sum()),
        "base_steps_mean": round(float(steps[solved].mean()), 1) if solved.any() else None,
        "base_steps_mean_all": round(float(steps.mean()), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--algorithms", nargs="+", default=list(ALGORITHMS), choices=ALGORITHMS)
    parser.add_argument("--frames", type=int, default=2_000_000)
    parser.add_argument("--copies", type=int, default=16)
    parser.add_argument("--mazes", type=int, default=342)
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results = []
    for name in arguments.algorithms:
        for seed in arguments.seeds:
            envs = DummyVecEnv(
                [lambda i=i, s=seed: make_env(1_000 * s + i) for i in range(arguments.copies)]
            )
            model = ALGORITHMS[name]("MlpPolicy", envs, seed=seed, device="cpu")
            begin = time.perf_counter()
            model.learn(arguments.frames)
            seconds = time.perf_counter() - begin
            results.append(
                {
                    "algorithm": name,
                    "seed": seed,
                    "train_base_steps": arguments.frames,
                    "train_seconds": round(seconds, 1),
                    "test": test(model, seed, arguments.mazes),
                }
            )
            print(json.dumps(results[-1]), flush=True)
            if arguments.out is not None:
                arguments.out.parent.mkdir(parents=True, exist_ok=True)
                report = {
                    "command": "python benchmarks/stable_baselines.py --seeds "
                    + " ".join(map(str, arguments.seeds))
                    + f" --frames {arguments.frames}",
                    "stable_baselines3": stable_baselines3.__version__,
                    "runs": results,
                }
                arguments.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
