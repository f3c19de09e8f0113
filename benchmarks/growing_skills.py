"""Skills added as needed, beside fixed numbers of skills, on the same mazes.

    python benchmarks/growing_skills.py --out docs/results/skills/growing_skills.json

For every seed (0, 1, 2) five workers are trained with 40,000 base steps each in the training mazes:
2, 4 and 8 skills with the settings of the demo, which were tuned for 4; one that starts with 2 and
decides for itself (``GrowSkills``, room for 12); and 4 skills with that one's discriminator. The
discriminator of the growing worker is linear without a bias: with one, a new skill can be told by
staying where it is, since the old ones have left, and need not learn to go. Then each worker plans
in the 342 test mazes, and its plans are executed in a separate instance of the env. Coverage is
the share of a maze's free tiles that a search of 2,000 simulated base steps reaches. What growing
simulated in the training mazes to measure coverage is listed beside the training.
"""

from __future__ import annotations

import json
import time
from typing import Any

import torch
from mazes import greedy, make_option_env, make_starts, planner
from skill_figures import search_coverage
from table import read_arguments, write
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
from torchrl_hmcts.trainers import DIAYNTrainer, GrowSkills, SearchCoverage
from torchrl_hmcts.trainers.evaluation import plan_and_execute, spread
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.transforms import DisplacementTransform, SkillMaskTransform, SkillTransform

ROOM = 12
NO_BIAS = "-no-bias"
WORKERS = ["2", "4", "8", "4" + NO_BIAS, "grown"]
COVERAGE_MAZES = 40


def macro_env(worker: Any, split: str, prior: SkillPrior) -> TransformedEnv:
    """The mazes of a split with the worker's skills as options, those that are off masked."""
    env = make_option_env(worker, maze_pool(split), num_skills=prior.num_skills)
    env.append_transform(SkillMaskTransform(prior))
    return env


def coverage_planner(env: TransformedEnv) -> MCTSPlanner:
    """Searches a fixed number of base steps, apart by the radius of the demo."""
    return MCTSPlanner(
        env,
        novelty=RadiusNovelty("position", DemoConfig().novelty_radius, max_relaxations=0),
        budget=SearchBudget(base_steps=2_000, until_plan=False),
        leaves_per_wave=4,
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


def train(name: str, seed: int, base_steps: int) -> tuple[SkillPolicy, SkillPrior, dict[str, Any]]:
    """Train a worker: ``"4"`` skills, ``"4-no-bias"``, or ``"grown"``."""
    begin = time.perf_counter()
    growing = GrowingSkillPrior(ROOM, num_active=2) if name == "grown" else None
    # None draws the random numbers that the demo draws: its workers are those of the fixed rows.
    prior = growing or FixedSkillPrior(int(name.removesuffix(NO_BIAS)))
    env = TransformedEnv(
        WaterworldMazeEnv(observation=False, batch_size=[32], max_steps=400),
        Compose(SkillTransform(prior.num_skills, 50, prior=growing), DisplacementTransform()),
    )
    if growing is not None or name.endswith(NO_BIAS):
        loss = make_loss_without_bias(env, prior.num_skills, growing, seed)
    else:
        loss = DIAYNTrainer.make_loss(env, prior.num_skills, seed=seed)
    trainer = DIAYNTrainer(env, loss, total_frames=base_steps, seed=seed)
    worker = greedy(loss)
    growth: dict[str, Any] = {"history": None, "coverage_base_steps": 0}
    if growing is not None:
        env_of_search = macro_env(worker, "train", prior)
        starts = make_starts(env_of_search.base_env, COVERAGE_MAZES, seed)
        coverage = SearchCoverage(coverage_planner(env_of_search), starts, prior)
        grow = GrowSkills(growing, coverage)
        grow.register(trainer)
    trainer.train()
    if growing is not None:
        growth = {"history": grow.history, "dropped": grow.dropped}
        growth["coverage_base_steps"] = coverage.base_steps
    growth["train_seconds"] = round(time.perf_counter() - begin, 1)
    return worker, prior, growth


def measure(name: str, seed: int, base_steps: int, num_mazes: int) -> dict[str, Any]:
    """Train one worker and take all figures."""
    worker, prior, growth = train(name, seed, base_steps)
    env, real = (macro_env(worker, "test", prior) for _ in range(2))
    starts = make_starts(env.base_env, num_mazes, seed)
    starts.set("action_mask", prior.active().expand(num_mazes, prior.num_skills).clone())
    results = plan_and_execute(planner(env, DemoConfig().novelty_radius, seed=0), real, starts)
    wide = coverage_planner(env)
    coverage = [search_coverage(wide.search(group), env.base_env) for group in starts.split(38)]
    return {
        "skills": name,
        "skills_at_the_end": int(prior.active().sum()),
        "seed": seed,
        "train_base_steps": base_steps,
        **growth,
        "coverage": spread(torch.cat(coverage).numpy()),
        "mazes": results.summary(),
    }


def main() -> None:
    quick = {"seeds": [0], "skills": ["4", "grown"], "mazes": 38}
    skills = (WORKERS, "of: " + ", ".join(WORKERS))
    args = read_arguments(
        __doc__, quick, seeds=[0, 1, 2], skills=skills, base_steps=40_000, mazes=342
    )
    rows = []
    for name in args.skills:
        for seed in args.seeds:
            rows.append(measure(name, seed, args.base_steps, args.mazes))
            print(json.dumps(rows[-1]), flush=True)
    write(args, {"rows": rows})


if __name__ == "__main__":
    main()
