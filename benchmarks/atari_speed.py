"""Emulated frames per second of the Atari pool under a search, against bare ALE processes.

Run: ``python benchmarks/atari_speed.py``. In turns, for as many rounds as asked: bare
processes that only call ``ale.act`` with random actions, and the whole agent, which is search,
trees, processes, network and RAM read-outs. The figure is the ratio within a round, so that a busy
machine slows both; frames per CPU second count the CPU time of all processes and their owner.
``--nodes`` measures the memory of a tree too.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_hmcts.envs import AtariOptionPool, RepeatActions, SharedMLP
from torchrl_hmcts.envs.atari.emulator import AtariEmulator, EmulatorSettings
from torchrl_hmcts.modules import SkillMLP
from torchrl_hmcts.planners.tree import TreeArrays
from torchrl_hmcts.trainers import AtariAgent, AtariSearch


def cpu_seconds(pids: list[int]) -> float:
    """CPU time of this process and some others so far."""
    ticks = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


def bare(game: str, frames: int, asked: Any, answers: Any) -> None:
    """Emulate as many frames as asked, again and again, and nothing else."""
    import ale_py
    import ale_py.roms

    from torchrl_hmcts.envs.atari.emulator import find_game

    ale = ale_py.ALEInterface()
    ale.setFloat("repeat_action_probability", 0.0)
    ale.loadROM(ale_py.roms.get_rom_path(find_game(game)[1]))
    ale.reset_game()
    actions = [int(a.value) for a in ale.getMinimalActionSet()]
    draws = np.random.default_rng(0).integers(len(actions), size=frames // 4)
    answers.put(os.getpid())
    while asked.get():
        done = 0
        for draw in draws.tolist():
            for _ in range(4):
                ale.act(actions[draw])
            done += 4
            if ale.game_over():
                ale.reset_game()
        answers.put(done)


class BareProcesses:
    """What the pool is compared with."""

    def __init__(self, count: int, game: str, frames: int) -> None:
        context = multiprocessing.get_context("forkserver")
        self.asked = [context.SimpleQueue() for _ in range(count)]
        self.answers = context.SimpleQueue()
        for asked in self.asked:
            context.Process(
                target=bare, args=(game, frames // count, asked, self.answers), daemon=True
            ).start()
        self.pids = [self.answers.get() for _ in self.asked]

    def run(self) -> dict[str, float]:
        began, worked = time.perf_counter(), cpu_seconds(self.pids)
        for asked in self.asked:
            asked.put(True)
        frames = sum(self.answers.get() for _ in self.asked)
        return rates(frames, time.perf_counter() - began, cpu_seconds(self.pids) - worked)

    def close(self) -> None:
        for asked in self.asked:
            asked.put(False)


def rates(frames: int, seconds: float, cpu: float) -> dict[str, float]:
    return {"frames_per_second": frames / seconds, "frames_per_cpu_second": frames / cpu}


class Agent:
    """Decision after decision: search, take the chosen option, continue from there."""

    def __init__(self, game: str, args: argparse.Namespace) -> None:
        num_actions = AtariEmulator(EmulatorSettings(game)).num_actions
        worker = SharedMLP(args.options, num_actions)
        network = SkillMLP(128, num_actions, args.options, hidden=(128, 128, 128))
        worker.load(network.parameters())
        self.pool = AtariOptionPool(
            game, worker, max_steps=args.steps, num_processes=args.processes, seed=0
        )
        search = AtariSearch(
            ratio=args.ratio, leaves_per_wave=args.leaves, waves_in_flight=args.waves
        )
        self.agent = AtariAgent(self.pool, search, seed=0)
        self.frames = args.frames
        self.run()

    def run(self) -> dict[str, float]:
        pool = self.pool
        began, worked, before = time.perf_counter(), cpu_seconds(pool.pids), pool.num_frames
        while pool.num_frames - before < self.frames:
            if self.agent.done:
                self.agent.begin()
            self.agent.play(1)
        seconds, cpu = time.perf_counter() - began, cpu_seconds(pool.pids) - worked
        return rates(pool.num_frames - before, seconds, cpu)


def memory(game: str, nodes: int) -> dict[str, float]:
    """Megabytes of a tree, growing as it must, and of the whole process at most."""
    worker = RepeatActions(18)
    pool = AtariOptionPool(game, worker, max_steps=1, num_processes=0, full_action_space=True)
    row = pool.reset().select("emulator_state").unsqueeze(0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    tree = TreeArrays(1, pool.num_options)
    zero = np.zeros(1, np.int64)
    for node in range(nodes):
        tree.reserve(node + 1)
        tree.set_states(zero, zero + node, row)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert tree.states is not None
    held = tree.nodes.nbytes + tree.edges.nbytes + tree.states["emulator_state"].nbytes
    return {
        "nodes": nodes,
        "room_for": tree.capacity,
        "megabytes": held / 1e6,
        "peak_megabytes_while_growing": (after - before) * 1024 / 1e6,
    }


def compare(game: str, args: argparse.Namespace) -> dict[str, Any]:
    """Run the agent and the bare processes in turns; return the medians and every round."""
    agent = Agent(game, args)
    others = BareProcesses(args.processes, game, args.frames)
    rounds = []
    for _ in range(args.rounds):
        ours, theirs = agent.run(), others.run()
        ratios = {key: ours[key] / theirs[key] for key in ours}
        rounds.append({"agent": ours, "bare": theirs, "ratio": ratios})
    agent.pool.close()
    others.close()
    result: dict[str, Any] = {"game": game, "restarts": agent.pool.num_restarts, "rounds": rounds}
    for name in ("agent", "bare", "ratio"):
        result[name] = {
            key: statistics.median(r[name][key] for r in rounds)
            for key in ("frames_per_second", "frames_per_cpu_second")
        }
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--games", nargs="+", default=["Breakout"])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--options", type=int, default=3)
    parser.add_argument("--steps", type=int, default=10, help="steps of an option")
    parser.add_argument("--leaves", type=int, default=8, help="leaves per wave")
    parser.add_argument("--waves", type=int, default=3, help="waves in flight")
    parser.add_argument("--ratio", type=float, default=25.0, help="simulated steps per real one")
    parser.add_argument("--frames", type=int, default=40_000, help="of one side of a round")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--nodes", type=int, default=0, help="of the tree whose memory is measured")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(
        "| game | agent, frames/s | bare | ratio | agent, frames per CPU second | bare | ratio |\n"
        "|---|---|---|---|---|---|---|"
    )
    games = []
    for game in args.games:
        games.append(compare(game, args))
        row = [
            f"{games[-1][name][key]:.{2 if name == 'ratio' else 0}f}"
            for key in ("frames_per_second", "frames_per_cpu_second")
            for name in ("agent", "bare", "ratio")
        ]
        print(f"| {game} | {' | '.join(row)} |", flush=True)
    result: dict[str, Any] = {
        "command": "python benchmarks/atari_speed.py",
        "arguments": {k: v for k, v in vars(args).items() if k != "out"},
        "games": games,
    }
    if args.nodes:
        result["memory"] = memory(args.games[0], args.nodes)
        print(json.dumps(result["memory"]))
    if args.out is not None:
        args.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
