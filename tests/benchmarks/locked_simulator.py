"""CPU time of a base step of a locked simulator: one state at a time, in a planner and alone.

    python tests/benchmarks/locked_simulator.py

The simulator is Gymnasium's CartPole in a ``GymEnv`` with ``set_state``, under an
``OptionTransform``; a search expands leaves, so that every option is a reset and its base steps.
"""

from __future__ import annotations

import math
import time
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Unbounded
from torchrl.envs import EnvBase, GymEnv, StepCounter, TransformedEnv

from torchrl_hmcts.planners import MCTSPlanner, SearchBudget
from torchrl_hmcts.transforms import OptionTransform


class SettableCartPole(GymEnv):
    """CartPole whose physical state is in the tensordict, and is restored when asked."""

    _supports_set_state = True

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("CartPole-v1", categorical_action_encoding=True, **kwargs)
        self._env.unwrapped.theta_threshold_radians = math.inf  # the pole never ends an option
        self._env.unwrapped.x_threshold = math.inf
        self.observation_spec["state"] = Unbounded(4, dtype=torch.float64)
        self.state_spec["state"] = self.observation_spec["state"].clone()

    def _read_state(self, td: TensorDictBase) -> TensorDictBase:
        return td.set("state", torch.tensor(self._env.unwrapped.state, dtype=torch.float64))

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **kwargs: Any
    ) -> TensorDictBase:
        out = super()._reset(tensordict, **kwargs)
        if set_state:
            assert tensordict is not None
            state = tensordict["state"].numpy().copy()
            self._env.unwrapped.state = state
            out["observation"] = torch.as_tensor(state.astype(np.float32))
        return self._read_state(out)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._read_state(super()._step(tensordict))


def macro_env(max_steps: int, counter: bool = False) -> EnvBase:
    """Two options, a push to the left or right that is held."""
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    env = TransformedEnv(SettableCartPole())
    if counter:
        env.append_transform(StepCounter())
    env.append_transform(OptionTransform(worker, 2, max_steps))
    return env


def per_step_of_bare_env(num_steps: int) -> float:
    env = gymnasium.make("CartPole-v1")
    env.reset(seed=0)
    begin = time.process_time()
    for step in range(num_steps):
        if any(env.step(step % 2)[2:4]):
            env.reset()
    return (time.process_time() - begin) / num_steps


def per_step_of_planner(env: EnvBase, expansions: int) -> tuple[float, float]:
    """Return seconds of CPU per base step and base steps per option."""
    budget = SearchBudget(expansions=expansions, until_plan=False)
    planner = MCTSPlanner(env, budget=budget, seed=0)
    root = env.reset()
    planner.search(root)  # compiles the loops
    begin = time.process_time()
    search = planner.search(root)
    seconds = time.process_time() - begin
    steps = int(search.num_base_steps[0])
    return seconds / steps, steps / int(search.num_simulations[0])


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    env = SettableCartPole()
    td = env.rand_action(env.reset())
    begin = time.process_time()
    for _ in range(5_000):
        env._step(td)
    gym_env = (time.process_time() - begin) / 5_000
    print("| | CPU us per base step | base steps per option |")
    print("|---|---|---|")
    print(f"| bare Gymnasium env | {1e6 * per_step_of_bare_env(20_000):.0f} | |")
    print(f"| `_step` of the GymEnv around it | {1e6 * gym_env:.0f} | |")
    for name, max_steps, counter in (
        ("planner, options of 8", 8, False),
        ("planner, options of 1", 1, False),
        ("planner, options of 8, StepCounter", 8, True),
    ):
        seconds, length = per_step_of_planner(macro_env(max_steps, counter), 200)
        print(f"| {name} | {1e6 * seconds:.0f} | {length:.1f} |")


if __name__ == "__main__":
    main()
