"""Skills added as needed, beside fixed numbers of skills, on the same mazes.

    python benchmarks/growing_skills.py --out docs/results/skills/growing_skills.json

For every seed (0, 1, 2) five workers are trained with 40,000 base steps each in the training mazes:
2, 4 and 8 skills with the settings of the demo, which were tuned for 4; one that starts with 2 and
decides for itself (``GrowSkills``, room for 12); and 4 skills with that one's discriminator. The
discriminator of the growing worker is linear without a bias: with one, a new skill can be told by
staying where it is, since the old ones have left, and need not learn to go. Then each worker plans
in the 342 test mazes, and its plans are carried out in a separate instance of the env. Coverage is
the share of a maze's free tiles that a search of 2,000 simulated base steps reaches. What growing
simulated in the training mazes to measure coverage is listed beside the training.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch
from skill_figures import search_coverage
from torch import nn
from torchrl.envs import Compose, TransformedEnv

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.modules import (
    FixedSkillPrior,
    GrowingSkillPrior,
    SkillActor,
    SkillCritic,
    SkillPolicy,
    SkillPrior,
)
from torchrl_hmcts.modules.skill_mlp import SkillNetwork
from torchrl_hmcts.objectives import DIAYNLoss
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.evaluation import plan_and_execute, spread
from torchrl_hmcts.trainers.experiments.demo import make_starts
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_option_env
from torchrl_hmcts.trainers.runs.config import FRAMES_PER_BATCH, DemoConfig
from torchrl_hmcts.trainers.skills.growing import GrowSkills, SearchCoverage
from torchrl_hmcts.transforms import (
    DisplacementTransform,
    SkillMaskTransform,
    SkillTransform,
)

ROOM = 12
NO_BIAS = "-no-bias"
WORKERS = ["2", "4", "8", "4" + NO_BIAS, "grown"]
COVERAGE_BASE_STEPS = 2_000
COVERAGE_MAZES = 40


def macro_env(worker: Any, split: str, prior: SkillPrior) -> TransformedEnv:
    """The mazes of a split with the worker's skills as options, those that are off masked."""
    env = make_option_env(worker, maze_pool(split), num_skills=prior.num_skills)
    env.append_transform(SkillMaskTransform(prior))
    return env


def coverage_planner(env: TransformedEnv) -> MCTSPlanner:
    """Searches a fixed number of base steps, apart by the radius of the demo."""
    config = DemoConfig()
    return MCTSPlanner(
        env,
        novelty=RadiusNovelty("position", config.novelty_radius, max_relaxations=0),
        budget=SearchBudget(base_steps=COVERAGE_BASE_STEPS, until_plan=False),
        leaves_per_wave=config.leaves_per_wave,
        seed=0,
    )


def make_loss_without_bias(
    env: TransformedEnv, number: int, prior: SkillPrior | None, seed: int
) -> DIAYNLoss:
    """The demo's networks, but for a discriminator whose regions are cones around the origin."""
    spec = env.action_spec_unbatched
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        actor = SkillActor(2, spec, number, in_keys=["velocity"])
        critic = SkillCritic(4, actor.num_actions, number, in_keys=["velocity", "displacement"])
        linear = nn.Linear(2, number, bias=False)
        discriminator = SkillNetwork(linear, ["displacement"], "skill_logits")
        return DIAYNLoss(
            actor, critic, discriminator, num_skills=number, prior=prior, action_space=spec
        )


def train(
    worker_name: str, seed: int, base_steps: int
) -> tuple[SkillPolicy, SkillPrior, dict[str, Any]]:
    """Train a worker: ``"4"`` skills, ``"4-no-bias"``, or ``"grown"``."""
    config = DemoConfig()
    begin = time.perf_counter()
    prior: SkillPrior
    if worker_name == "grown":
        prior = GrowingSkillPrior(ROOM, num_active=2)
    else:
        prior = FixedSkillPrior(int(worker_name.removesuffix(NO_BIAS)))
    # None draws the random numbers that the demo draws: its workers are those of the fixed rows.
    live = prior if isinstance(prior, GrowingSkillPrior) else None
    env = TransformedEnv(
        WaterworldMazeEnv(observation=False, batch_size=[32], max_steps=400),
        Compose(
            SkillTransform(prior.num_skills, config.skill_steps, prior=live),
            DisplacementTransform(),
        ),
    )
    if worker_name == "grown" or worker_name.endswith(NO_BIAS):
        loss = make_loss_without_bias(env, prior.num_skills, live, seed)
    else:
        loss = DIAYNTrainer.make_loss(env, prior.num_skills, seed=seed, prior=live)
    trainer = DIAYNTrainer(
        env,
        loss,
        total_frames=base_steps,
        frames_per_batch=FRAMES_PER_BATCH,
        seed=seed,
    )
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    growth: dict[str, Any] = {"history": None, "coverage_base_steps": 0}
    if isinstance(prior, GrowingSkillPrior):
        env_of_search = macro_env(worker, "train", prior)
        starts = make_starts(env_of_search.base_env, COVERAGE_MAZES, seed)
        coverage = SearchCoverage(coverage_planner(env_of_search), starts, prior)
        grow = GrowSkills(prior, coverage)
        grow.register(trainer)
        trainer.train()
        growth = {
            "history": grow.history,
            "dropped": grow.dropped,
            "coverage_base_steps": coverage.base_steps,
        }
    else:
        trainer.train()
    growth["train_seconds"] = round(time.perf_counter() - begin, 1)
    return worker, prior, growth


def measure(worker_name: str, seed: int, base_steps: int, num_mazes: int) -> dict[str, Any]:
    """Train one worker and take all figures."""
    config = DemoConfig()
    worker, prior, growth = train(worker_name, seed, base_steps)
    env, real = (macro_env(worker, "test", prior) for _ in range(2))
    starts = make_starts(env.base_env, num_mazes, seed)
    starts.set("action_mask", prior.active().expand(num_mazes, prior.num_skills).clone())
    planner = MCTSPlanner(
        env,
        novelty=RadiusNovelty("position", config.novelty_radius, shorter_paths=True),
        budget=SearchBudget(expansions=config.expansions),
        leaves_per_wave=config.leaves_per_wave,
        seed=0,
    )
    solved = plan_and_execute(planner, real, starts)
    wide = coverage_planner(env)
    coverage = torch.cat(
        [search_coverage(wide.search(group), env.base_env) for group in starts.split(38)]
    )
    return {
        "skills": worker_name,
        "skills_at_the_end": int(prior.active().sum()),
        "seed": seed,
        "train_base_steps": base_steps,
        **growth,
        "coverage": spread(coverage.numpy()),
        "mazes": solved.summary(),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The figures as a markdown table."""
    head = [
        "skills",
        "seed",
        "at the end",
        "solved",
        "simulated base steps, mean / median (95 %)",
        "executed base steps, median (95 %)",
        "coverage, mean",
        "training base steps + simulated for coverage",
    ]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for row in rows:
        simulated, executed = (row["mazes"][k] for k in ("simulated_steps", "episode_steps"))
        cells = [
            row["skills"],
            row["seed"],
            row["skills_at_the_end"],
            f"{row['mazes']['solved']} of {row['mazes']['starts']}",
            f"{simulated['mean']:,.0f} / {simulated['median']:,.0f} ({simulated['p95']:,.0f})",
            f"{executed['median']:,.0f} ({executed['p95']:,.0f})",
            f"{row['coverage']['mean']:.3f}",
            f"{row['train_base_steps']:,} + {row['coverage_base_steps']:,}",
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--skills", nargs="+", default=WORKERS, help="of: " + ", ".join(WORKERS))
    parser.add_argument("--base-steps", type=int, default=40_000)
    parser.add_argument("--mazes", type=int, default=342)
    parser.add_argument("--quick", action="store_true", help="one seed, 4 and grown, 38 mazes")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    args = parser.parse_args()
    if args.quick:
        args.seeds, args.skills, args.mazes = [0], ["4", "grown"], 38
    torch.set_num_threads(1)
    rows = []
    for skills in args.skills:
        for seed in args.seeds:
            rows.append(measure(skills, seed, args.base_steps, args.mazes))
            print(json.dumps(rows[-1]), flush=True)
    print(table(rows))
    if args.out is not None:
        args.out.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
