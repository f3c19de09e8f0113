"""AntMaze: an ant learns to walk without a reward, and a planner takes it to goals.

    python benchmarks/antmaze.py learn antmaze-large-v0 --seeds 0
    python benchmarks/antmaze.py learn AntMaze_Large-v5 --seeds 0 --frames 75000 --width 128
    python benchmarks/antmaze.py solve antmaze-medium-v0 antmaze-large-v0 antmaze-giant-v0 \\
        AntMaze_Medium-v5 AntMaze_Large-v5 --seeds 0
    python benchmarks/antmaze.py draw

**Learning** is LSD on the (x, y) displacement, by soft actor-critic on TorchRL's Trainer, in the
ant's maze with walls that touch nothing. There is no reward of the env, no goal, and no term for
staying up: an episode ends where the ant falls. One worker of each ant serves all mazes.

**Planning** is tree search over options of 2.5 s in :class:`MujocoBatch`; plans are executed in a
separate Gymnasium env with its time limit of 1,000 steps, and made again where an option ends in
another state than planned or the plan has ended. Starts of OGBench's mazes are its 5 tasks, 10
times each with its noise; those of gymnasium-robotics are 50 draws of its own.

Each part adds to ``results.json`` and ``episodes.csv`` in ``docs/results/antmaze``, so that it can
run in pieces.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ant_walker import (
    ACTIONS,
    BODY,
    Gait,
    Imagine,
    SkillFrame,
    Walker,
    act,
    fallen,
    normalized,
    open_arena,
)
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from tensordict import TensorDictBase
from torchrl.data import Bounded
from torchrl.envs import Compose, StepCounter, TransformedEnv

from torchrl_hmcts.envs import MujocoBatch
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.modules import SkillActionCritic, SkillActor, SkillEncoder, SpectralLinear
from torchrl_hmcts.objectives import LSDEncoderLoss, SkillSACLoss
from torchrl_hmcts.planners import UCT, MCTSPlanner, RadiusNovelty, SearchBudget, extract_plans
from torchrl_hmcts.planners.drawing import option_color
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.evaluation import spread
from torchrl_hmcts.trainers.figures.pictures import save_figure
from torchrl_hmcts.transforms import OptionTransform, SkillReward, SkillTransform

OUT, WORKERS = Path("docs/results/antmaze"), Path("runs/antmaze")
NUM_SKILLS = 3
OPTION_STEPS = 25  # actions, of 0.1 s


def make_actor(width: int = 256) -> SkillActor:
    spec = Bounded(-1.0, 1.0, shape=(ACTIONS,))
    return SkillActor(BODY, spec, NUM_SKILLS, hidden=(width, width), in_keys=["body"])


def learn(
    name: str,
    *,
    seed: int = 0,
    total_frames: int = 51_200,
    width: int = 256,
    copies: int = 16,
    skill_steps: int = 100,
    updates_per_batch: int = 16,
    imagined: float = 0.5,
    scale: float = 10.0,
    lr: float = 5e-4,
) -> tuple[SkillActor, dict[str, Any]]:
    """Learn three skills of an ant without a reward.

    Args:
        name: of an env with the ant.
        seed: of the run.
        total_frames: actions; of gymnasium-robotics' ant each is two env steps.
        width: of the two hidden layers of actor and critics.
        copies: ants side by side.
        skill_steps: actions of a mini-episode.
        updates_per_batch: for each 64 actions.
        imagined: share of replayed transitions that :class:`Imagine` changes.
        scale: of LSD's reward, in which a metre is about 1.
        lr: of actor, critics and alpha; the encoder's is twice as high.

    Returns:
        The actor, and what it cost and how fast it became.
    """
    torch.manual_seed(seed)
    gait = Gait.of(name)
    begin = time.process_time()
    base = MujocoBatch(lambda: open_arena(name), task=gait.arena, batch_size=[copies], seed=seed)
    frames = Compose(SkillTransform(NUM_SKILLS, max_skill_steps=skill_steps), SkillFrame())
    encoder = SkillEncoder(
        2, NUM_SKILLS, in_keys=["displacement"], hidden=(), linear=SpectralLinear
    )
    actor = make_actor(width)
    loss = SkillSACLoss(
        actor,
        SkillActionCritic(
            BODY,
            ACTIONS,
            NUM_SKILLS,
            hidden=(width, width),
            in_keys=["body"],
            activation=normalized(width),
        ),
        LSDEncoderLoss(encoder),
        gamma=0.98,
        alpha_init=0.1,
        fixed_alpha=False,
        target_entropy=-float(ACTIONS),
    )
    reward = SkillReward(loss.objective, intrinsic_coeff=scale)
    trainer = DIAYNTrainer(
        TransformedEnv(base, frames),
        loss,
        total_frames=total_frames,
        updates_per_batch=updates_per_batch,
        buffer_size=total_frames,
        actor_lr=lr,
        critic_lr=lr,
        objective_lr=2 * lr,
        alpha_lr=lr,
        target_tau=0.01,
        reward=Compose(Imagine(NUM_SKILLS, imagined), reward),
        seed=seed,
    )
    curve = Curve(loss, total_frames)
    trainer.register_op("post_steps_log", curve)
    trainer.train()
    actor.load_state_dict(_weights(loss, actor))
    cost: dict[str, Any] = {"width": width, "actions": total_frames}
    cost |= {
        "env_steps": total_frames * gait.repeat,
        "updates": len(trainer.history["alpha"]) * updates_per_batch,
    }
    return actor, cost | {"cpu_seconds": round(time.process_time() - begin), "curve": curve.rows}


def _weights(loss: SkillSACLoss, actor: SkillActor) -> dict[str, Any]:
    """The trained weights of an actor, which a loss holds apart from it."""
    with loss.actor_network_params.to_module(loss.actor_network, preserve_module_state=False):
        return {k: v.detach().clone() for k, v in loss.actor_network.state_dict().items()}


class Curve:
    """Notes metres an action in the direction of the skill, and falls, as the worker learns."""

    def __init__(self, loss: SkillSACLoss, total: int, points: int = 20) -> None:
        self.rows: list[list[float]] = []
        self._loss, self._frames, self._every = loss, 0, total // points
        self._sums = np.zeros(3)

    def __call__(self, batch: TensorDictBase) -> dict[str, float]:
        # A metre is worth sqrt(1.5), the length of a skill's vector among three.
        metres = self._loss.objective.finite_reward(batch) / 1.5**0.5
        falls = batch["next", "terminated"].sum()
        self._sums += (len(batch), float(metres.sum()), float(falls))
        self._frames += len(batch)
        if self._frames >= self._every * (len(self.rows) + 1):
            count, total, falls = self._sums
            self.rows.append([self._frames, round(total / count, 4), falls])
            self._sums[:] = 0
            print(self.rows[-1], f"{time.process_time():.0f} CPU-s", flush=True)
        return {}


# ---------------------------------------------------------------- planning


def starts_of(name: str, per_task: int, first: int) -> list[tuple[int, dict[str, Any] | None]]:
    """Seeds and options of ``env.reset``."""
    if name.startswith("antmaze"):
        return [
            (10 * t + i, {"task_id": t})
            for i in range(first, first + per_task)
            for t in range(1, 6)
        ]
    return [(seed, None) for seed in range(5 * first, 5 * (first + per_task))]


class Agent:
    """Plans over a worker's options, and executes in an env of its own."""

    def __init__(self, name: str, actor: SkillActor, radius: float, budget: int) -> None:
        keywords = {} if name.startswith("antmaze") else {"continuing_task": False}
        self.worker = Walker(actor)
        self.batch = MujocoBatch(name, task=Gait.of(name).task, seed=0, **keywords)
        self.env = make_gym(name, **keywords)
        self.repeat = Gait.of(name).repeat
        limit = StepCounter(max_steps=self.env.spec.max_episode_steps // self.repeat)
        options = OptionTransform(
            self.worker, self.worker.num_options, OPTION_STEPS, termination=fallen
        )
        self.planner = MCTSPlanner(
            TransformedEnv(self.batch, Compose(limit, options)),
            tree_policy=UCT(c=1.0),
            novelty=RadiusNovelty("position", radius),
            budget=SearchBudget(base_steps=budget),
            leaves_per_wave=4,
            seed=0,
        )

    def solve(self, seed: int, options: dict[str, Any] | None, max_plans: int) -> dict[str, Any]:
        """One episode of the env; what it cost, and the places on the way."""
        self.env.reset(seed=seed, options=options and dict(options))
        start = self.batch.read(self.env)
        row: dict[str, Any] = {"seed": seed, **(options or {}), "solved": False, "steps": 0}
        row |= {"plans": 0, "planned_options": 0, "differs": 0, "simulated": 0, "plan_cpu": 0.0}
        path, ended = [start["position"].tolist()], False
        while not ended and row["plans"] < max_plans:
            begin = time.process_time()
            taken = torch.tensor([row["steps"] // self.repeat])
            search = self.planner.search(self.batch.read(self.env).set("step_count", taken))
            plan = extract_plans(search)[0]
            row["plan_cpu"] += time.process_time() - begin
            row["simulated"] += int(search.num_base_steps[0])
            row["plans"] += 1
            if not bool(plan.found):
                break
            row["planned_options"] = row["planned_options"] or int(plan.lengths)
            for i, option in enumerate(plan.options[: int(plan.lengths)].tolist()):
                earned, ended, steps, places = act(
                    self.env, self.batch, self.worker, option, OPTION_STEPS
                )
                path += places[1:]
                row["steps"] += steps
                row["solved"] |= earned > 0
                if ended:
                    break
                reached = self.batch.read(self.env)["physics"]
                if not torch.equal(plan.states.get("physics")[i + 1], reached):
                    row["differs"] += 1
                    break
        row["plan_cpu"] = round(row["plan_cpu"], 2)
        self.search, self.path, self.start = search, path, start
        return row


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts, and what a start cost."""
    solved = [row for row in rows if row["solved"]]
    out: dict[str, Any] = {"starts": len(rows), "solved": len(solved)}
    tasks = sorted({row["task_id"] for row in rows if "task_id" in row})
    if tasks:
        out["solved_by_task"] = [sum(r["solved"] for r in rows if r["task_id"] == t) for t in tasks]
    for name in ("plan_cpu", "simulated", "plans"):
        out[name] = spread([row[name] for row in rows])
    out["steps_of_solved"] = spread([row["steps"] for row in solved])
    return out


# ---------------------------------------------------------------- pictures


def draw_skills(actors: dict[str, SkillActor], path: Path) -> None:
    """Draw where the options lead from one standing start, of each ant in the open."""
    figure = Figure(figsize=(8.4, 4.4), layout="constrained")
    panels = figure.subplots(1, len(actors), sharex=True, sharey=True)
    for axes, (name, actor) in zip(panels, actors.items(), strict=True):
        env = open_arena(name)
        batch, worker = MujocoBatch(name, task=Gait.of(name).task), Walker(actor)
        for option in range(worker.num_options):
            env.reset(seed=0)
            _, _, _, places = act(env, batch, worker, option, OPTION_STEPS)
            x, y = (np.array(places) - places[0]).T
            axes.plot(x, y, color=option_color(option // 2), label=f"skill {option // 2}")
        axes.set_title(name, fontsize=10, loc="left")
        axes.set_aspect("equal")
        axes.set_xlabel("metres in 2.5 s")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles[::2], names[::2], loc="outside lower center", ncols=NUM_SKILLS)
    save_figure(figure, path)


def draw_plan(agent: Agent, path: Path) -> None:
    """Draw where the agent's last search was, and the way that the ant then went."""
    figure = Figure(figsize=(8.4, 6.4), layout="constrained")
    axes = figure.subplots()
    model, tree = agent.batch.model, agent.search.tree
    for i in range(model.ngeom):
        geom = model.geom(i)
        if geom.bodyid[0] == 0 and geom.name.startswith("block"):
            corner, size = geom.pos[:2] - geom.size[:2], 2 * geom.size[:2]
            axes.add_patch(Rectangle(tuple(corner), *size, color="0.2"))
    assert tree.states is not None
    places = tree.states["physics"][0, : int(tree.num_nodes[0]), 1:3]
    axes.plot(*places.T.numpy(), ".", color="0.6", markersize=4, label="states the search held")
    axes.plot(*np.array(agent.path).T, color=option_color(0), label="executed", linewidth=2)
    goal = agent.start["goal"].tolist()
    axes.plot(*goal, "*", color=option_color(1), markersize=16, label="goal")
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    save_figure(figure, path)


# ---------------------------------------------------------------- command line


def kind_of(name: str) -> str:
    return "ogbench" if name.startswith("antmaze") else "robotics"


def note(part: str, key: str, entry: Any, out: Path) -> None:
    """Write an entry of the results beside those that are there."""
    path = out / "results.json"
    results = json.loads(path.read_text()) if path.exists() else {"learning": {}, "solving": {}}
    results[part][key] = entry
    out.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def note_episodes(key: str, rows: list[dict[str, Any]], out: Path) -> None:
    """Write a row for each episode beside those that are there."""
    path, others = out / "episodes.csv", []
    if path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            others = [row for row in csv.DictReader(file) if row["of"] != key]
    every = others + [{"of": key, "task_id": "", **row} for row in rows]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(every[-1]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(every)


def load_actor(name: str, seed: int) -> SkillActor:
    weights = torch.load(WORKERS / f"{kind_of(name)}-{seed}.pt", weights_only=True)
    actor = make_actor(width=len(next(iter(weights.values()))))
    actor.load_state_dict(weights)
    return actor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("learn", "solve", "draw"))
    parser.add_argument("names", nargs="*")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--frames", type=int, default=51_200, help="actions of learning")
    parser.add_argument("--width", type=int, default=256, help="of the networks that learn")
    parser.add_argument("--starts", type=int, default=10, help="of each of 5 tasks")
    parser.add_argument(
        "--first", type=int, default=0, help="the first of these, to share them out"
    )
    parser.add_argument("--radius", type=float, default=2.0, help="metres that are a new place")
    parser.add_argument("--budget", type=int, default=80_000, help="actions that a plan simulates")
    parser.add_argument("--untrained", action="store_true", help="the worker before it learns")
    parser.add_argument("--out", type=Path, default=OUT)
    args = parser.parse_args()
    torch.set_num_threads(1)
    WORKERS.mkdir(parents=True, exist_ok=True)
    for name in args.names:
        for seed in args.seeds:
            if args.part == "learn":
                actor, cost = learn(name, seed=seed, total_frames=args.frames, width=args.width)
                torch.save(actor.state_dict(), WORKERS / f"{kind_of(name)}-{seed}.pt")
                note("learning", f"{kind_of(name)} seed {seed}", cost, args.out)
            elif args.part == "solve":
                torch.manual_seed(seed)
                actor = make_actor() if args.untrained else load_actor(name, seed)
                agent, rows = Agent(name, actor, args.radius, args.budget), []
                key = f"{name} seed {seed}" + " untrained" * args.untrained
                for i, start in enumerate(starts_of(name, args.starts, args.first)):
                    rows.append(agent.solve(*start, max_plans=5))
                    print(rows[-1], flush=True)
                    if i % 5 == 4:
                        note("solving", key, summary(rows), args.out)
                        note_episodes(key, rows, args.out)
    if args.part == "draw":
        seed = args.seeds[0]
        actors = {n: load_actor(n, seed) for n in ("antmaze-giant-v0", "AntMaze_Large-v5")}
        draw_skills(actors, args.out / "skills.png")
        name = "antmaze-giant-v0"
        agent = Agent(name, actors[name], args.radius, args.budget)
        agent.solve(10, {"task_id": 1}, max_plans=1)
        draw_plan(agent, args.out / "plan.png")


if __name__ == "__main__":
    main()
