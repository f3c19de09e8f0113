"""CPU time of a base step of a locked simulator: one state at a time, in a planner and alone.

    python benchmarks/locked_simulator.py

Two simulators under an ``OptionTransform``: Gymnasium's CartPole in a ``GymEnv`` with
``set_state``, and a TorchRL env whose step is 15 us of tensordict. A search expands 100 leaves, so
that every option is one reset and its base steps. The best of 5 searches counts: shared cores vary.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Binary, Categorical, Composite, Unbounded
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


class Walk(EnvBase):
    """A walk along a line that ends nowhere, kept in the env."""

    _supports_set_state = True

    def __init__(self) -> None:
        super().__init__(batch_size=())
        self.place = torch.zeros(())
        self.observation_spec = Composite(place=Unbounded(()))
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Categorical(2, shape=())
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(
            done=Binary(1, dtype=torch.bool), terminated=Binary(1, dtype=torch.bool)
        )
        self.nothing, self.never = torch.zeros(1), torch.zeros(1, dtype=torch.bool)

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **kwargs: Any
    ) -> TensorDictBase:
        self.place = torch.zeros(())
        if set_state and tensordict is not None:
            self.place = tensordict["place"].clone()
        return TensorDict({"place": self.place}, [])

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.place = self.place + (2 * tensordict["action"] - 1)
        ends = {"done": self.never, "terminated": self.never}
        return TensorDict({"place": self.place, "reward": self.nothing, **ends}, [])

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


def macro_env(base: EnvBase, max_steps: int, counter: bool = False) -> EnvBase:
    """Two options, one of the two actions that is held."""
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    env = TransformedEnv(base)
    if counter:
        env.append_transform(StepCounter())
    env.append_transform(OptionTransform(worker, 2, max_steps))
    return env


def best(measure: Callable[[], float]) -> float:
    measure()  # compiles the loops, fills the caches
    return 1e6 * min(measure() for _ in range(5))


def per_step(step: Callable[[], Any], num_steps: int = 2_000) -> float:
    begin = time.process_time()
    for _ in range(num_steps):
        step()
    return (time.process_time() - begin) / num_steps


def per_step_of_planner(env: EnvBase) -> float:
    budget = SearchBudget(expansions=100, until_plan=False)
    planner = MCTSPlanner(env, budget=budget, seed=0)
    root = env.reset()
    begin = time.process_time()
    search = planner.search(root)
    return (time.process_time() - begin) / int(search.num_base_steps[0])


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    gym = gymnasium.make("CartPole-v1").unwrapped
    gym.reset(seed=0)
    gym.theta_threshold_radians = gym.x_threshold = math.inf
    rows = {"Gymnasium's CartPole alone": best(lambda: per_step(lambda: gym.step(0)))}
    for name, make in (("GymEnv", SettableCartPole), ("EnvBase", Walk)):
        base = make()
        td = base.rand_action(base.reset())
        rows[f"`_step` of the {name} alone"] = best(
            lambda b=base, t=td: per_step(lambda: b._step(t))
        )
        for max_steps, counter in ((20, False), (8, False), (1, False), (8, True)):
            env = macro_env(make(), max_steps, counter)
            below = " over a StepCounter" if counter else ""
            rows[f"{name} in a planner, options of {max_steps}{below}"] = best(
                lambda e=env: per_step_of_planner(e)
            )
    print("| | CPU us per base step |\n|---|---|")
    for name, microseconds in rows.items():
        print(f"| {name} | {microseconds:.0f} |")


if __name__ == "__main__":
    main()
