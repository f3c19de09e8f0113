"""Stable-Baselines3's A2C and PPO on the same mazes, with the budget of chapter 3's agents.

    python benchmarks/stable_baselines.py --seeds 0 --out FILE.json

They play the env that Gymnasium knows as torchrl_hmcts/WaterworldMaze-v0 (observation: player,
target, walls) with the velocity beside it, 16 copies, and the hyperparameters with which
Stable-Baselines3 comes. Tested like our agents: one episode in each of 342 test mazes, actions
sampled. Needs `pip install stable-baselines3`.
"""

from __future__ import annotations

import json
import time
from functools import partial
from itertools import product
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.vec_env import DummyVecEnv
from table import read_arguments, write

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
    arguments = read_arguments(
        __doc__,
        {"frames": 4_000, "mazes": 3},
        seeds=[0],
        algorithms=list(ALGORITHMS),
        frames=2_000_000,
        copies=16,
        mazes=342,
    )
    seeds = " ".join(map(str, arguments.seeds))
    report: dict[str, Any] = {
        "command": f"python benchmarks/stable_baselines.py --seeds {seeds} "
        f"--frames {arguments.frames}",
        "stable_baselines3": stable_baselines3.__version__,
        "runs": [],
    }
    for name, seed in product(arguments.algorithms, arguments.seeds):
        makers = [partial(make_env, 1_000 * seed + i) for i in range(arguments.copies)]
        model = ALGORITHMS[name]("MlpPolicy", DummyVecEnv(makers), seed=seed, device="cpu")
        begin = time.perf_counter()
        model.learn(arguments.frames)
        row = {"algorithm": name, "seed": seed, "train_base_steps": arguments.frames}
        row["train_seconds"] = round(time.perf_counter() - begin, 1)
        row["test"] = test(model, seed, arguments.mazes)
        report["runs"].append(row)
        print(json.dumps(row), flush=True)
        write(arguments, report)


if __name__ == "__main__":
    main()
