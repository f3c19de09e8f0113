"""What each part of the agent is worth: search, novelty test, simulation step, learned skills.

    python benchmarks/ablations.py --seeds 0 1 2 --out docs/results/ablations.json
    python benchmarks/ablations.py --tables search --tasks "apples 15" --seeds 0

An arm is a line of words as `hmcts train` takes them, and what cannot be said in words: a worker
that was never trained, a search with a queue, a random tree policy. Rows that the file already has
are not run again.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from queue_search import ORDERS, plan_by_queue
from table import add_row, markdown, read_arguments
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.trainers.command_line.words import parse_config
from torchrl_hmcts.trainers.evaluation import Results, plan_and_execute
from torchrl_hmcts.trainers.experiments.kits import Kit, make_kit
from torchrl_hmcts.trainers.experiments.managers import learn_manager
from torchrl_hmcts.trainers.experiments.registry import DEMO, EXPERIMENTS
from torchrl_hmcts.trainers.experiments.skills import learn, make_loss, solve
from torchrl_hmcts.trainers.figures.intervals import bootstrap, wilson
from torchrl_hmcts.trainers.skills.rounds import frames_curve

COMMAND = "python benchmarks/ablations.py --seeds 0 1 2 --out docs/results/ablations.json"
TASKS: dict[str, tuple[str, ...]] = {  # kit, then words
    "maze": ("waterworld", "mazes=50"),
    "maze, 100": ("waterworld", "mazes=100"),
    "maze, 20": ("waterworld", "mazes=20"),
    "maze 15": ("waterworld", "mazes=50", "size=15", "search_steps=30000"),
    "boat": ("waterworld", "mazes=50", "task=boat", "search_steps=15000"),
    "key 15": ("waterworld", "mazes=30", "task=key", "size=15", "search_steps=60000"),
    "apples 15": ("waterworld", "mazes=50", "task=apples", "size=15"),
    "lab": ("labmaze", "mazes=50", "curve_points=0"),
    "maze, tested": ("waterworld", "mazes=50", "curve_points=10"),
    "lab, tested": ("labmaze", "mazes=50"),
    "lab turn": ("labmaze", "mazes=50", "task=turn", "curve_points=0", "search_frames=80000"),
    "lab apples 15": (
        *("labmaze", "mazes=50", "task=apples", "size=15", "curve_points=0"),
        *("max_frames=1200", "search_frames=16000"),
    ),
}


@dataclass(frozen=True)
class Arm:
    """A row of a table: a task with other words, worker, search or simulation step."""

    table: str
    task: str
    name: str
    words: tuple[str, ...] = ()
    worker: str = "trained"
    search: str = ""
    seed: int = 0
    worker_seed: int | None = None


def arms(seeds: Sequence[int]) -> Iterator[Arm]:
    """Yield all rows, the tasks in which the parts matter first."""
    for task in ("boat", "lab turn", "maze", "lab"):
        for seed in range(10):
            yield Arm(
                "worker", task, "untrained", worker="untrained", seed=seeds[0], worker_seed=seed
            )
    for seed in seeds:
        yield from searches("apples 15", seed)
        for task in ("boat", "lab turn"):
            yield from workers(task, seed)
        for task in ("maze, tested", "lab, tested"):
            yield from features(task, seed)
        for task in ("maze, tested", "lab, tested"):
            words = ("algorithm=hmcts",)
            yield Arm("algorithm 3", task, "Algorithm 3 from scratch", words, seed=seed)
    for seed in seeds:
        for task in ("maze", "lab"):
            yield from workers(task, seed)
        for task in ("maze, 100", "key 15", "lab apples 15"):
            yield from searches(task, seed)
        for task in ("maze", "maze 15"):
            for manager in ("novelty", "learned"):
                yield Arm("manager", task, manager, (f"manager={manager}",), seed=seed)
        yield from simulations(seed)
        for length in (10, 25, 50, 100):
            words = (f"option_steps={length}", f"novelty_radius={min(2.0, 0.04 * length):g}")
            yield Arm("option length", "maze", f"{length} base steps", words, seed=seed)


def searches(task: str, seed: int) -> Iterator[Arm]:
    """Yield the searches of a task with one worker."""
    uct = "planner/tree_policy=uct"
    for name, words in {
        "UCT, c = 1": (uct, "planner.tree_policy.c=1"),
        "UCT, c = 0.3": (uct, "planner.tree_policy.c=0.3"),
        "UCT, c = 0": (uct, "planner.tree_policy.c=0"),
        "PUCT": ("planner/tree_policy=puct",),
        "UCT, c = 0.3, max": (uct, "planner.tree_policy.c=0.3", "planner.backup=max"),
    }.items():
        yield Arm("search", task, name, words, seed=seed)
    yield Arm("search", task, "random option", search="random option", seed=seed)
    for name in ORDERS:
        yield Arm("search", task, name, search=name, seed=seed)


def simulations(seed: int) -> Iterator[Arm]:
    """Yield random simulations from new nodes, with and without a novelty test."""
    rollouts = ("planner/leaf_evaluator=rollout",)
    for name, words in {
        "simulation none; novelty place": (),
        "simulation none; novelty none": ("features=none",),
        "simulation random, 10 options; novelty place": rollouts,
    }.items():
        yield Arm("simulation", "maze, 100", name, words, seed=seed)
    name = "the dissertation's four stages"
    yield Arm("simulation", "maze, 20", name, ("manager=four_stages",), seed=seed)


def workers(task: str, seed: int) -> Iterator[Arm]:
    """Yield the workers of a task."""
    is_lab = task.startswith("lab")
    key, unit = ("train_frames", 4) if is_lab else ("train_base_steps", 1)
    for steps in (10_240, 20_480, 40_960) + (81_920,) * (task == "boat"):
        words = (f"{key}={steps * unit}",)
        yield Arm("worker", task, f"DIAYN, {steps:,} base steps", words, seed=seed)
    for objective in ("metra", "lsd", "dads"):
        yield Arm("worker", task, objective.upper(), (f"objective={objective}",), seed=seed)
    yield Arm("worker", task, "hand-written", worker="hand-written", seed=seed)


def features(task: str, seed: int) -> Iterator[Arm]:
    """Yield what the novelty test compares."""
    yield Arm("novelty", task, "(x, y), radius by hand", seed=seed)
    whole = ("objective=metra", "objective_key=observation")
    learned = ("objective=metra", "features=learned")
    yield Arm("novelty", task, "METRA of the place, its radius found", learned, seed=seed)
    words = (*whole, "features=learned")
    yield Arm("novelty", task, "METRA of the whole observation, its radius found", words, seed=seed)
    words = ("objective_key=observation", "features=learned")
    yield Arm("novelty", task, "DIAYN's guess of the skill, its radius found", words, seed=seed)
    words = ("objective_key=observation", "features=none")
    yield Arm("novelty", task, "none; discriminator of the whole observation", words, seed=seed)
    yield Arm("novelty", task, "none", ("features=none",), seed=seed)


def steer(heading: Tensor, skill: Tensor) -> Tensor:
    """Return 0 (ahead) when a body faces the direction of its skill, else 1 or 2 (left, right)."""
    angle = skill * (torch.pi / 2)
    cross = heading[..., 0] * angle.sin() - heading[..., 1] * angle.cos()
    along = heading[..., 0] * angle.cos() + heading[..., 1] * angle.sin()
    turn = torch.where(cross < 0.0, 1, 2)
    return torch.where(along > 0.95, 0, turn)


def hand_written(task: str) -> TensorDictModule:
    """Return a worker by rule: thrust or walk in a direction, or turn to it and go ahead."""
    if task in ("boat", "lab turn"):
        flip = -1.0 if task == "lab turn" else 1.0  # y to the north
        mirror = torch.tensor([1.0, flip])
        return TensorDictModule(
            lambda heading, skill: steer(heading * mirror, skill), ["heading", "skill"], ["action"]
        )
    return TensorDictModule(lambda skill: skill, ["skill"], ["action"])


@lru_cache(maxsize=4)
def trained(kit_name: str, words: tuple[str, ...]) -> tuple[Any, float, dict[str, Any]]:
    """Return a worker's loss, its CPU seconds, and how it did while it learned."""
    kit = configured(kit_name, words)
    learned = learn(kit)
    config, columns = kit.config, frames_curve(learned.tests, 1, kit.config.max_frames)
    if not columns:
        return learned.loss, learned.seconds, {}
    steps = [int(x) for x in columns["training_steps"]]
    curve = {"base_steps": steps, "solved": columns["solved"], "mazes": config.curve_mazes}
    return learned.loss, learned.seconds, {"curve": curve}


def configured(kit_name: str, words: Sequence[str]) -> Kit:
    """Return the kit that words describe."""
    experiment = DEMO if kit_name == "waterworld" else EXPERIMENTS["labmaze"]
    return make_kit(parse_config(experiment, list(words)))


_PLANNING = (
    "planner",
    "manager",
    "features",
    "search_",
    "mazes",
    "size",
    "novelty_radius",
    "option_steps",
)


def measure(arm: Arm) -> dict[str, Any]:
    """Solve the test mazes of an arm."""
    kit_name, *words = TASKS[arm.task]
    worker_seed = arm.seed if arm.worker_seed is None else arm.worker_seed
    words += [*arm.words, f"seed={arm.seed}"]
    kit = configured(kit_name, words)
    if arm.table != "algorithm 3":  # one search, of which the steps are compared
        kit.second_try = lambda: None  # type: ignore[method-assign]
    seconds, curve = 0.0, {}
    if arm.worker == "hand-written":
        worker: Any = hand_written(arm.task)
    elif arm.worker == "untrained":
        made = configured(kit_name, [*words[:-1], f"seed={worker_seed}"])
        worker = SkillPolicy(make_loss(made).actor_network, deterministic=True)
    else:
        learning = [word for word in words if not word.startswith(_PLANNING)]
        loss, seconds, curve = trained(kit_name, tuple(learning))
        kit.note(loss)
        worker = SkillPolicy(loss.actor_network, deterministic=True)
    if kit.config.manager == "learned":
        begin = time.process_time()
        train = kit.make_simulator(worker, "train")
        network = learn_manager(kit, train, searches=400, iterations=4, updates=200)
        kit.manager = kit.manager_for(network, "test")
        seconds += time.process_time() - begin
    begin = time.process_time()
    results = run(kit, arm, worker)
    return {
        **{name: getattr(arm, name) for name in ("table", "task", "seed")},
        "arm": arm.name,
        "worker_seed": worker_seed,
        "words": " ".join([f"kit={kit_name}", *words]),
        "solved": results.solved.astype(int).tolist(),
        "simulated": results.simulated_steps.tolist(),
        "executed": results.episode_steps.tolist(),
        "rewards": [round(float(reward), 3) for reward in results.rewards],
        **curve,
        "training_cpu_seconds": round(seconds, 1),
        "cpu_seconds": round(time.process_time() - begin, 1),
    }


def run(kit: Kit, arm: Arm, worker: Any) -> Results:
    """Plan from each start, execute the plan in another instance."""
    kit.prepare(worker)
    starts = kit.starts("test", kit.config.mazes)
    real = kit.make_real(worker)
    planner = kit.make_planner(kit.make_simulator(worker))
    if arm.table == "algorithm 3":
        return solve(kit, worker).results
    if arm.search in ORDERS:
        return plan_by_queue(planner, real, starts, arm.search, arm.seed)
    if arm.search == "random option":
        generator = torch.Generator().manual_seed(arm.seed)
        planner.tree_policy = lambda at: torch.rand(at.option_visits.shape, generator=generator)
    group = 1 if arm.table == "simulation" else 38  # steps of rollouts belong to one search
    return plan_and_execute(planner, real, starts, group=group)


def pooled(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Join the rows of an arm over its seeds, with intervals."""
    solved, simulated, rewards, executed = (
        np.concatenate([row[key] for row in rows])
        for key in ("solved", "simulated", "rewards", "executed")
    )
    low, high = wilson(int(solved.sum()), len(solved))
    mean, least, most = bootstrap(rewards.tolist())
    shares = [np.mean(row["solved"]) for row in sorted(rows, key=lambda r: r["worker_seed"])]
    return {
        **{key: rows[0][key] for key in ("table", "task", "arm")},
        "seeds": len({(row["seed"], row["worker_seed"]) for row in rows}),
        "solved": f"{solved.mean():.0%} ({low:.0%} to {high:.0%})",
        "by seed": ", ".join(f"{share:.0%}" for share in shares),
        "simulated": f"{np.median(simulated):,.0f} ({np.percentile(simulated, 95):,.0f})",
        "executed": f"{np.median(executed[solved > 0]):,.0f}" if solved.any() else "",
        "reward": f"{mean:.2f} ({least:.2f} to {most:.2f})",
    }


def by_name(*names: str) -> dict[str, Any]:
    """Return columns that show entries of a row."""
    return {name: (lambda row, name=name: row[name]) for name in names}


def tables(rows: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Return all tables as markdown, by table and task."""
    groups: dict[tuple[str, str], dict[str, list[dict[str, Any]]]] = {}
    for row in rows:
        groups.setdefault((row["table"], row["task"]), {}).setdefault(row["arm"], []).append(row)
    text = {}
    for (table, task), found in groups.items():
        last = "reward" if "apples" in task else "executed"
        columns = by_name("arm", "seeds", "solved", "by seed", "simulated", last)
        text[f"{table}, {task}"] = markdown(map(pooled, found.values()), columns)
    return text


def fill(page: str, found: dict[str, str]) -> str:
    """Return a page with the table behind each comment that names one."""
    for name, table in found.items():
        pattern = rf"(<!-- {re.escape(name)} -->\n\n)(?:\|.*\n)*\n?"
        page = re.sub(pattern, lambda match, table=table: f"{match[1]}{table}\n\n", page)
    return page.rstrip() + "\n"


def main() -> None:
    args = read_arguments(
        __doc__,
        {"seeds": [0], "tasks": ["boat"], "tables": ["worker"]},
        seeds=[0, 1, 2],
        tables=(["all"], "search, simulation, worker, novelty, option length"),
        tasks=(["all"], "those of TASKS"),
        page=("", "page whose tables are to be filled"),
    )
    out = args.out or Path("runs/ablations.json")
    out.parent.mkdir(parents=True, exist_ok=True)
    keys = ("table", "task", "arm", "seed", "worker_seed")
    for arm in arms(args.seeds):
        wanted = {"all", arm.table} & set(args.tables) and {"all", arm.task} & set(args.tasks)
        done = json.loads(out.read_text())["rows"] if out.exists() else []
        worker_seed = arm.seed if arm.worker_seed is None else arm.worker_seed
        mine = (arm.table, arm.task, arm.name, arm.seed, worker_seed)
        if not wanted or any(tuple(row[key] for key in keys) == mine for row in done):
            continue
        row = measure(arm)
        add_row(out, row, *keys, command=COMMAND)
        shown = by_name("table", "task", "arm", "solved", "simulated", "reward")
        print(markdown([pooled([row])], shown).splitlines()[-1], flush=True)
    found = tables(json.loads(out.read_text())["rows"])
    if args.page:
        page = Path(args.page)
        page.write_text(fill(page.read_text(), found))
    print("\n\n".join(f"{name}\n\n{table}" for name, table in found.items()))


if __name__ == "__main__":
    main()
