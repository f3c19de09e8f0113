"""Skill objectives side by side: what a planner achieves with the skills each of them teaches.

Each objective trains the demo's worker (same env, networks, 40,000 base steps, trainer); only the
objective is swapped. Then the reference planner solves the test mazes with the skills.

    python benchmarks/skill_objectives.py --seeds 0 1 2 \\
        --out docs/results/skills/skill_objectives.json
    python benchmarks/skill_objectives.py --quick
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.modules import (
    SkillActor,
    SkillCritic,
    SkillDiscriminator,
    SkillDynamics,
    SkillEncoder,
    SkillPolicy,
    SpectralLinear,
)
from torchrl_hmcts.objectives import (
    DiscreteSkillSACLoss,
    LSDEncoderLoss,
    METRAEncoderLoss,
    SkillDiscriminatorLoss,
    SkillDynamicsLoss,
    SkillObjective,
)
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.evaluation import plan_and_execute
from torchrl_hmcts.trainers.experiments.demo import make_starts
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_option_env, make_training_env
from torchrl_hmcts.transforms import SkillReward

NUM_SKILLS, OPTION_STEPS, BASE_STEPS = 4, 25, 40_000


class Recipe:
    """An objective, the entries its critics see, and the scale of its reward.

    Args:
        make: builds the objective.
        critic_keys: what the critics see besides the skill: whatever the reward is a function of.
        coeff: factor of the reward, which is weighed against alpha times the entropy.
        objective_lr: Adam's learning rate of the objective.
    """

    def __init__(
        self,
        make: Callable[[], SkillObjective],
        critic_keys: tuple[str, ...] = ("velocity",),
        coeff: float = 1.0,
        objective_lr: float = 1e-2,
    ) -> None:
        self.make, self.critic_keys = make, critic_keys
        self.coeff, self.objective_lr = coeff, objective_lr


RECIPES = {
    "DIAYN": Recipe(
        lambda: SkillDiscriminatorLoss(SkillDiscriminator(2, NUM_SKILLS)),
        ("velocity", "displacement"),
    ),
    "METRA": Recipe(lambda: METRAEncoderLoss(SkillEncoder(2, NUM_SKILLS)), coeff=3.0),
    "LSD": Recipe(
        lambda: LSDEncoderLoss(SkillEncoder(2, NUM_SKILLS, linear=SpectralLinear)), coeff=10.0
    ),
    "DADS": Recipe(lambda: SkillDynamicsLoss(SkillDynamics(2, 2, NUM_SKILLS)), coeff=0.5),
}


def train(recipe: Recipe, seed: int, base_steps: int) -> tuple[DiscreteSkillSACLoss, float]:
    """Trains the demo's worker with an objective; returns its loss and the seconds it took."""
    env = make_training_env(num_skills=NUM_SKILLS)
    width = 2 * len(recipe.critic_keys)
    torch.manual_seed(seed)
    loss = DiscreteSkillSACLoss(
        SkillActor(2, env.action_spec_unbatched, NUM_SKILLS, in_keys=["velocity"]),
        SkillCritic(width, 4, NUM_SKILLS, in_keys=recipe.critic_keys),
        recipe.make(),
        action_space=env.action_spec_unbatched,
    )
    begin = time.perf_counter()
    DIAYNTrainer(
        env,
        loss,
        total_frames=base_steps,
        objective_lr=recipe.objective_lr,
        reward=SkillReward(loss.objective, intrinsic_coeff=recipe.coeff),
        seed=seed,
    ).train()
    return loss, time.perf_counter() - begin


@torch.no_grad()
def mean_displacements(
    worker: SkillPolicy, make_env: Callable[[int], EnvBase], per_skill: int = 256
) -> np.ndarray:
    """Returns where skills lead in 50 base steps, on average over mazes, ``[Z, 2]`` (tiles)."""
    copies = NUM_SKILLS * per_skill
    env = make_env(copies)
    env.set_seed(7)
    skill = torch.arange(NUM_SKILLS).repeat_interleave(per_skill)
    td = env.reset(TensorDict(skill=skill, batch_size=[copies]))
    end = env.rollout(50, worker, auto_reset=False, tensordict=td, break_when_any_done=False)
    moved = end[:, -1]["next", "displacement"].view(NUM_SKILLS, per_skill, 2).mean(1)
    return moved.numpy()


def angles(moved: np.ndarray) -> list[float]:
    """Returns the angles between the skills' directions, the smallest first (degrees)."""
    unit = moved / np.maximum(np.linalg.norm(moved, axis=-1, keepdims=True), 1e-9)
    cosines = [float(unit[i] @ unit[j]) for i, j in combinations(range(len(unit)), 2)]
    return sorted(float(np.degrees(np.arccos(np.clip(c, -1.0, 1.0)))) for c in cosines)


def evaluate(loss: DiscreteSkillSACLoss, num_mazes: int, seed: int) -> dict[str, Any]:
    """Plans over the skills in test mazes and carries the plans out."""
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    mazes = maze_pool("test")
    options = {"num_skills": NUM_SKILLS, "option_steps": OPTION_STEPS}
    simulator, real = (make_option_env(worker, mazes, **options) for _ in range(2))
    planner = MCTSPlanner(
        simulator,
        novelty=RadiusNovelty("position", 0.7, shorter_paths=True),
        leaves_per_wave=4,
        budget=SearchBudget(expansions=1000),
    )
    starts = make_starts(real.base_env, num_mazes, seed)
    results = plan_and_execute(planner, real, starts).summary()
    moved = mean_displacements(
        worker, lambda copies: make_training_env(mazes, num_skills=NUM_SKILLS, copies=copies)
    )
    lengths = np.linalg.norm(moved, axis=-1)
    return {
        **results,
        "mean_displacements": moved.round(3).tolist(),
        "mean_displacement_length": round(float(lengths.mean()), 3),
        "smallest_length": round(float(lengths.min()), 3),
        "smallest_angle": round(angles(moved)[0], 1),
    }


def markdown(rows: list[dict[str, Any]]) -> str:
    """Returns the table of results, one line per objective, over its seeds."""
    lines = [
        "| objective | seeds | solved, by seed | simulated steps, median | episode steps, median "
        "| smallest angle, by seed | displacement, tiles | training, s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(row["objective"] for row in rows):
        runs = [row for row in rows if row["objective"] == name]

        def mean(key: str, part: str | None = None, runs: Any = runs) -> float:
            return float(np.mean([r[key][part] if part else r[key] for r in runs]))

        solved = ", ".join(f"{r['solved']}/{r['starts']}" for r in runs)
        smallest = ", ".join(f"{r['smallest_angle']:.0f}" for r in runs)
        lines.append(
            f"| {name} | {len(runs)} | {solved} | {mean('simulated_steps', 'median'):,.0f} "
            f"| {mean('episode_steps', 'median'):.0f} | {smallest} "
            f"| {mean('mean_displacement_length'):.2f} | {mean('train_seconds'):.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--mazes", type=int, default=342)
    parser.add_argument("--base-steps", type=int, default=BASE_STEPS)
    parser.add_argument("--objectives", nargs="+", default=list(RECIPES), choices=list(RECIPES))
    parser.add_argument("--quick", action="store_true", help="one seed, 60 mazes")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.quick:
        args.seeds, args.mazes = args.seeds[:1], 60
    torch.set_num_threads(1)
    rows = []
    for name in args.objectives:
        for seed in args.seeds:
            loss, seconds = train(RECIPES[name], seed, args.base_steps)
            row = {
                "objective": name,
                "seed": seed,
                "train_base_steps": args.base_steps,
                "train_seconds": round(seconds, 1),
                "reward_scale": RECIPES[name].coeff,
                **evaluate(loss, args.mazes, seed),
            }
            rows.append(row)
            print(json.dumps(row), flush=True)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(rows, indent=2) + "\n")
    print("\n" + markdown(rows))


if __name__ == "__main__":
    main()
