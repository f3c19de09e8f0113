"""How the planner scales, and what it costs beside its simulator.

    python benchmarks/planner_figures.py [--out FILE.json]

Prints the cost per simulation at 1,000 and at 100,000 nodes, the memory of a node, and the share
of the planner in a macro expansion on Waterworld and, where ale-py is installed, on Atari
(Breakout, RAM).
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.planners import (
    PUCT,
    MCTSPlanner,
    RadiusNovelty,
    Root,
    Search,
    SearchBudget,
    Transition,
    tree_search,
)
from torchrl_hmcts.planners.tree import EDGE, NODE
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_option_env, make_starts

clock = time.thread_time


class Thrust(TensorDictModuleBase):
    """Takes the action of the skill's number."""

    in_keys = ["skill"]
    out_keys = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", tensordict.get("skill"))


def grow(num_simulations: int) -> tuple[float, float]:
    """Seconds per simulation, and mean depth of a leaf, while a tree of that size is grown."""
    options = 10

    def transition(state: np.ndarray, option: np.ndarray) -> Transition:
        m = len(state)
        zero, one = np.zeros(m, np.float32), np.ones(m, np.float32)
        return Transition(zero, one, np.full((m, options), 0.1, np.float32), zero, state)

    root = Root(np.full((1, options), 0.1, np.float32), np.zeros(1, np.float32), np.zeros(1))
    begin = clock()
    search: Search = tree_search(root, transition, num_simulations, tree_policy=PUCT(c=1.0))
    seconds = (clock() - begin) / num_simulations
    return seconds, float(search.tree.nodes["depth"][0, 1:num_simulations].mean())


def scaling() -> dict[str, Any]:
    grow(1_000)
    small = [grow(1_000) for _ in range(30)]
    large = [grow(100_000) for _ in range(3)]
    t1, d1 = np.median(small, axis=0)
    t2, d2 = np.median(large, axis=0)
    return {
        "us_per_simulation_at_1000": round(float(1e6 * t1), 2),
        "us_per_simulation_at_100000": round(float(1e6 * t2), 2),
        "mean_depth": [round(float(d1), 2), round(float(d2), 2)],
        "ratio": round(float(t2 / t1), 2),
        "ratio_per_level": round(float(t2 / d2 / (t1 / d1)), 2),
        "bytes_per_node": NODE.itemsize,
        "bytes_per_option": EDGE.itemsize,
    }


def overhead(planner: MCTSPlanner, start: TensorDictBase, searches: int) -> dict[str, Any]:
    """The planner's own share of the time of a search, everything but the simulator's step."""
    simulator, spent = planner.simulator, [0.0, 0.0]
    step = simulator.env._step

    def timed(states: TensorDictBase) -> TensorDictBase:
        begin = clock()
        after = step(states)
        spent[0] += clock() - begin
        return after

    planner.search(start)
    waves = 0
    simulator.env.__dict__["_step"] = timed
    for _ in range(searches):
        begin = clock()
        search = planner.search(start)
        spent[1] += clock() - begin
        waves += int(search.num_expansions[0])
    del simulator.env.__dict__["_step"]
    own = spent[1] - spent[0]
    return {
        "expansions": waves,
        "ms_per_expansion": round(1e3 * spent[1] / waves, 3),
        "planner_ms_per_expansion": round(1e3 * own / waves, 3),
        "planner_share": round(own / spent[1], 4),
    }


def waterworld() -> dict[str, Any]:
    env = make_option_env(Thrust(), maze_pool("test"), option_steps=40)
    planner = MCTSPlanner(
        env,
        novelty=RadiusNovelty("position", 0.7),
        budget=SearchBudget(expansions=60, until_plan=False),
    )
    return overhead(planner, make_starts(env.base_env, 1, seed=0), searches=5)


class BreakoutOptions(EnvBase):
    """Four options that hold an action for ten steps of four frames; state: the emulator's."""

    batch_locked = False
    _supports_set_state = True

    def __init__(self) -> None:
        import ale_py

        super().__init__(batch_size=[])
        ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
        self._ale_py, self.ale = ale_py, ale_py.ALEInterface()
        self.ale.setFloat("repeat_action_probability", 0.0)
        self.ale.setInt("frame_skip", 4)
        self.ale.loadROM(ale_py.roms.get_rom_path("breakout"))
        self.actions = self.ale.getMinimalActionSet()
        self.size = len(self.ale.cloneState().serialize())
        state = Unbounded((self.size,), dtype=torch.uint8)
        self.state_spec = Composite(emulator=state)
        self.observation_spec = Composite(
            emulator=state.clone(), ram=Unbounded((128,), dtype=torch.uint8)
        )
        self.action_spec = Categorical(4, shape=())
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(done=Binary(1, dtype=torch.bool))

    def _entries(self) -> tuple[torch.Tensor, torch.Tensor]:
        state = np.frombuffer(self.ale.cloneState().serialize(), np.uint8).copy()
        return torch.from_numpy(state), torch.from_numpy(self.ale.getRAM())

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        self.ale.reset_game()
        emulator, ram = self._entries()
        return TensorDict({"emulator": emulator, "ram": ram}, [])

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        rows = []
        for state, action in zip(
            tensordict["emulator"].numpy(), tensordict["action"].tolist(), strict=True
        ):
            self.ale.restoreState(self._ale_py.ALEState(state.tobytes()))
            reward = sum(self.ale.act(self.actions[action]) for _ in range(10))
            rows.append((*self._entries(), float(reward), self.ale.game_over()))
        emulator, ram, reward, done = zip(*rows, strict=True)
        done = torch.tensor(done).unsqueeze(-1)
        reward = torch.tensor(reward).unsqueeze(-1)
        entries = {"emulator": torch.stack(emulator), "ram": torch.stack(ram), "reward": reward}
        return TensorDict({**entries, "done": done}, tensordict.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        """The emulator is deterministic."""


def atari() -> dict[str, Any] | str:
    try:
        env = BreakoutOptions()
    except ImportError:
        return "not measured: pip install ale-py"
    planner = MCTSPlanner(
        env, tree_policy=PUCT(), budget=SearchBudget(expansions=60, until_plan=False)
    )
    return {"state_bytes": env.size, **overhead(planner, env.reset()[None], searches=3)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    args = parser.parse_args()
    torch.set_num_threads(1)
    figures = {"tree": scaling(), "waterworld": waterworld(), "atari": atari()}
    print(json.dumps(figures, indent=2))
    if args.out is not None:
        args.out.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
