"""AntMaze: an ant learns to walk without a reward, and a planner takes it to goals.

    python benchmarks/antmaze.py learn ogbench robotics --seeds 0 1 2
    python benchmarks/antmaze.py solve antmaze-giant-v0 --seeds 0 --starts 50
    python benchmarks/antmaze.py solve antmaze-medium-v0 --starts 5 --untrained
    python benchmarks/antmaze.py table
    python benchmarks/antmaze.py draw

It is ``HMCTS(id, kit="ant")``; one worker of each ant serves all its mazes. Start number i is that
of ``hmcts train kit=ant`` with ``seed=i``, in OGBench of task i modulo 5, with the env's own noise;
the plan is executed in a separate Gymnasium env with its time limit. Each start adds a row to
``episodes.csv`` in ``docs/results/antmaze``, and those that are there are left out, so that it can
run in pieces. CPU-seconds of a start are those of its search and its execution, in one process.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from torchrl_hmcts.envs.gym.mujoco import find_physics
from torchrl_hmcts.planners.drawing import option_color
from torchrl_hmcts.trainers import HMCTS
from torchrl_hmcts.trainers.evaluation import spread
from torchrl_hmcts.trainers.experiments.kits.ant import open_arena
from torchrl_hmcts.trainers.experiments.kits.film import Film
from torchrl_hmcts.trainers.experiments.skills import make_loss
from torchrl_hmcts.trainers.figures.intervals import wilson
from torchrl_hmcts.trainers.figures.pictures import save_figure
from torchrl_hmcts.trainers.saving.worker_file import save_worker

OUT, RUNS = Path("docs/results/antmaze"), Path("runs/antmaze")
SMALL: dict[str, Any] = {"hidden": 128}
LONG: dict[str, Any] = {"train_base_steps": 75_008, "trainer": {"buffer_size": 75_000}}
ANTS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {  # shape, and training
    "ogbench": ("antmaze-large-v0", {}, {}),
    "robotics": ("AntMaze_Large-v5", SMALL, LONG),
}
COLUMNS = ("env", "seed", "start", "task", "solved", "steps", "options", "simulated", "cpu")


def kind_of(name: str) -> str:
    return "ogbench" if name.startswith("antmaze") else "robotics"


def make_agent(name: Any, kind: str, seed: int, *, untrained: bool = False) -> HMCTS:
    """Return an agent with the worker of an ant."""
    first, shape, _ = ANTS[kind]
    folder = RUNS / f"{kind}-{seed}"
    if untrained:
        folder = RUNS / f"{kind}-{seed}-untrained"
        folder.mkdir(parents=True, exist_ok=True)
        fresh = HMCTS(first, kit="ant", options="learned", seed=seed, **shape)
        save_worker(folder, make_loss(fresh.kit), 0)
        shape = {**shape, "expansions": 100}  # there will be no plan
    return HMCTS(name, kit="ant", seed=seed, worker=str(folder), **shape)


def learn(kind: str, seed: int) -> dict[str, Any]:
    """Train the worker of an ant, and return what it cost."""
    name, shape, training = ANTS[kind]
    agent = HMCTS(name, kit="ant", seed=seed, **shape, **training).learn()
    agent.save(RUNS / f"{kind}-{seed}", overwrite=True)
    assert agent.learned is not None
    repeat = agent.kit.gym_env.get_wrapper_attr("repeat")
    return {
        "actions": agent.learned.steps,
        "env_steps": agent.learned.steps * repeat,
        "cpu_seconds": round(agent.learned.seconds),
    }


def solve(agent: HMCTS, name: str, start: int) -> dict[str, Any]:
    """Plan and act from a start."""
    begin = time.process_time()
    found = agent.solve(seed=start)
    return {
        "task": start % 5 + 1 if kind_of(name) == "ogbench" else "",
        "solved": int(bool(found.solved)),
        "steps": found.base_steps * agent.kit.gym_env.get_wrapper_attr("repeat"),
        "options": found.num_options,
        "simulated": found.simulated_steps,
        "cpu": round(time.process_time() - begin, 2),
    }


def read_rows(out: Path) -> list[dict[str, str]]:
    path = out / "episodes.csv"
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def add_row(row: dict[str, Any], out: Path) -> None:
    path = out / "episodes.csv"
    is_new = not path.exists()
    out.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(row)


def summary(rows: list[dict[str, str]]) -> dict[str, Any]:
    """Return counts, and what a start cost."""
    solved = sum(int(row["solved"]) for row in rows)
    seeds = sorted({int(row["seed"]) for row in rows})
    out: dict[str, Any] = {"seeds": seeds, "starts": len(rows), "solved": solved}
    out |= {
        "percent": round(100 * solved / len(rows), 1),
        "wilson": [round(100 * x, 1) for x in wilson(solved, len(rows))],
    }
    tasks = sorted({row["task"] for row in rows} - {""})
    if tasks:
        counts = [[int(row["solved"]) for row in rows if row["task"] == task] for task in tasks]
        out["solved_by_task"] = [f"{sum(count)}/{len(count)}" for count in counts]
    for key in ("cpu", "simulated"):
        out[key] = spread([float(row[key]) for row in rows])
    steps = [float(row["steps"]) for row in rows if row["solved"] == "1"]
    out["steps_of_solved"] = spread(steps) | {"most": max(steps, default=None)}
    return out


def write_results(out: Path, **learned: Any) -> None:
    """Write the summary of all rows beside what the trainings cost, and print a table."""
    path, rows = out / "results.json", read_rows(out)
    results = json.loads(path.read_text()) if path.exists() else {"learning": {}}
    results["learning"] |= learned
    groups: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        for key in (row["env"], f"{row['env']} seed {row['seed']}"):
            groups.setdefault(key, []).append(row)
    results["solving"] = {key: summary(group) for key, group in sorted(groups.items())}
    path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    for key, told in results["solving"].items():
        print(key, *(told[name] for name in ("solved", "starts", "percent", "wilson")))


# ---------------------------------------------------------------- pictures


def draw_skills(seed: int, path: Path) -> None:
    """Draw where the options lead from one standing start, of each ant in the open."""
    figure = Figure(figsize=(8.4, 4.4), layout="constrained")
    panels = figure.subplots(1, len(ANTS), sharex=True, sharey=True)
    for axes, (kind, (name, *_)) in zip(panels, ANTS.items(), strict=True):
        agent = make_agent(partial(open_arena, name), kind, seed)
        kit: Any = agent.kit
        film, start = Film(kit.look.features), agent.start(0)
        pool = kit.make_pool(agent.worker, film=film)
        for option in range(pool.num_options):
            film.clear()
            pool.step(start.clone().set("option", torch.tensor([option])))
            x, y, _ = (np.array(film.points) - start["features"][0].numpy()).T
            axes.plot(x, y, color=option_color(option // 2), label=f"skill {option // 2}")
        axes.set_title(name, fontsize=10, loc="left")
        axes.set_aspect("equal")
        axes.set_xlabel("metres in 2.5 s")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles[::2], names[::2], loc="outside lower center", ncols=3)
    save_figure(figure, path)


def draw_plan(agent: HMCTS, start: int, path: Path) -> None:
    """Draw the states of a search, and the way that the ant then went."""
    figure = Figure(figsize=(8.4, 6.4), layout="constrained")
    axes = figure.subplots()
    begin = agent.start(start)
    way = agent.kit.film(agent.worker, agent.planner, begin).states[0]["features"][:, :2]
    model, _ = find_physics(agent.kit.gym_env)
    for i in range(model.ngeom):
        geom = model.geom(i)
        if geom.bodyid[0] == 0 and geom.name.startswith("block"):
            corner, size = geom.pos[:2] - geom.size[:2], 2 * geom.size[:2]
            axes.add_patch(Rectangle(tuple(corner), *size, color="0.2"))
    tree: Any = agent.planner.last_search.tree  # type: ignore[union-attr]
    places = tree.states["features"][0, : int(tree.num_nodes[0]), :2]
    axes.plot(*places.T.numpy(), ".", color="0.6", markersize=4, label="states the search held")
    axes.plot(*way.T.numpy(), color=option_color(0), label="executed", linewidth=2)
    goal = begin["desired_goal"][0].tolist()
    axes.plot(*goal, "*", color=option_color(1), markersize=16, label="goal")
    axes.set(aspect="equal", xticks=[], yticks=[])
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("learn", "solve", "table", "draw"))
    parser.add_argument("names", nargs="*", help="of envs, or of ants that learn")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--starts", type=int, default=50)
    parser.add_argument("--untrained", action="store_true", help="the worker before it learns")
    parser.add_argument("--out", type=Path, default=OUT)
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    for name, seed in ((name, seed) for name in args.names for seed in args.seeds):
        if args.part == "learn":
            write_results(args.out, **{f"{name} seed {seed}": learn(name, seed)})
            continue
        agent = make_agent(name, kind_of(name), seed, untrained=args.untrained)
        told = {"env": name + " untrained" * args.untrained, "seed": str(seed)}
        done = [row["start"] for row in read_rows(args.out) if told.items() <= row.items()]
        for start in range(args.starts):
            if str(start) not in done:
                row = {**told, "start": start, **solve(agent, name, start)}
                add_row(row, args.out)
                print(row, flush=True)
    if args.part == "table":
        write_results(args.out)
    if args.part == "draw":
        draw_skills(args.seeds[0], args.out / "skills.png")
        agent = make_agent("antmaze-giant-v0", "ogbench", args.seeds[0])
        draw_plan(agent, 0, args.out / "plan.png")


if __name__ == "__main__":
    main()
