"""Skill objectives side by side: what a planner achieves with the skills each of them teaches.

Each objective trains the demo's worker (same env, trainer, 40,000 base steps); only the objective
is swapped, and the skills, which are four or vectors. Then the reference planner solves the test
mazes with the skills; of vectors, with eight that are spread out.

    python benchmarks/skill_objectives.py --seeds 0 1 2 \\
        --out docs/results/skills/skill_objectives.json
    python benchmarks/skill_objectives.py --seeds 0 1 2 \\
        --objectives "METRA, vectors" "LSD, vectors" \\
        --out docs/results/skills/skill_vectors.json
    python benchmarks/skill_objectives.py --quick
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import torch
from mazes import greedy, solve
from table import markdown, read_arguments, write
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, TensorSpec, Unbounded
from torchrl.envs import TransformedEnv

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.modules import (
    SkillActor,
    SkillCritic,
    SkillDiscriminator,
    SkillDynamics,
    SkillEncoder,
    SkillPolicy,
    SpectralLinear,
    UnitSphere,
    spread_skills,
)
from torchrl_hmcts.objectives import (
    DiscreteSkillSACLoss,
    LSDEncoderLoss,
    METRAEncoderLoss,
    SkillDiscriminatorLoss,
    SkillDynamicsLoss,
    SkillObjective,
)
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env
from torchrl_hmcts.transforms import OptionTransform, SkillReward

SKILLS = 4
VECTORS = 8  # options, of skills that are vectors


@dataclass
class Recipe:
    """An objective, the entries its critics see, and the scale of its reward."""

    make: Callable[[], SkillObjective]
    coeff: float = 1.0  # of the reward, which is weighed against alpha times the entropy
    critic_keys: tuple[str, ...] = ("velocity",)  # and what the reward is a function of
    skills: Any = SKILLS  # or the spec of a vector

    def options(self) -> Tensor | None:
        """Return the vectors that are the options, ``[Z, D]``; None: all skills are."""
        return spread_skills(self.skills, VECTORS) if isinstance(self.skills, TensorSpec) else None


# As in the papers.
SPHERE, NORMAL, BOX = UnitSphere(2), Unbounded(shape=(2,)), Bounded(-1.0, 1.0, shape=(2,))

RECIPES = {
    "DIAYN": Recipe(
        lambda: SkillDiscriminatorLoss(SkillDiscriminator(2, SKILLS)),
        critic_keys=("velocity", "displacement"),
    ),
    "METRA": Recipe(lambda: METRAEncoderLoss(SkillEncoder(2, SKILLS)), 3.0),
    "LSD": Recipe(lambda: LSDEncoderLoss(SkillEncoder(2, SKILLS, linear=SpectralLinear)), 10.0),
    "DADS": Recipe(lambda: SkillDynamicsLoss(SkillDynamics(2, 2, SKILLS)), 0.5),
    "METRA, vectors": Recipe(lambda: METRAEncoderLoss(SkillEncoder(2, SPHERE)), 3.0, skills=SPHERE),
    "LSD, vectors": Recipe(
        lambda: LSDEncoderLoss(SkillEncoder(2, NORMAL, linear=SpectralLinear)), 10.0, skills=NORMAL
    ),
    "DADS, vectors": Recipe(lambda: SkillDynamicsLoss(SkillDynamics(2, 2, BOX)), 0.5, skills=BOX),
}


def train(recipe: Recipe, seed: int, base_steps: int) -> tuple[DiscreteSkillSACLoss, float]:
    """Train the demo's worker with an objective; return its loss and the seconds it took."""
    env = make_training_env(num_skills=recipe.skills)
    torch.manual_seed(seed)
    loss = DiscreteSkillSACLoss(
        SkillActor(2, env.action_spec_unbatched, recipe.skills, in_keys=["velocity"]),
        SkillCritic(2 * len(recipe.critic_keys), 4, recipe.skills, in_keys=recipe.critic_keys),
        recipe.make(),
        action_space=env.action_spec_unbatched,
    )
    begin = time.perf_counter()
    reward = SkillReward(loss.objective, intrinsic_coeff=recipe.coeff)
    DIAYNTrainer(env, loss, total_frames=base_steps, reward=reward, seed=seed).train()
    return loss, time.perf_counter() - begin


@torch.no_grad()
def mean_displacements(worker: SkillPolicy, recipe: Recipe, per_skill: int = 256) -> np.ndarray:
    """Return where options lead in 50 base steps, on average over mazes, ``[Z, 2]`` (tiles)."""
    vectors = recipe.options()
    told = torch.arange(SKILLS) if vectors is None else vectors
    copies = len(told) * per_skill
    env = make_training_env(maze_pool("test"), num_skills=recipe.skills, copies=copies)
    env.set_seed(7)
    skill = told.repeat_interleave(per_skill, 0)
    td = env.reset(TensorDict(skill=skill, batch_size=[copies]))
    end = env.rollout(50, worker, auto_reset=False, tensordict=td, break_when_any_done=False)
    return end[:, -1]["next", "displacement"].view(-1, per_skill, 2).mean(1).numpy()


def make_vector_env(worker: SkillPolicy, mazes: Tensor, *, skills: Tensor) -> TransformedEnv:
    """Build a Waterworld whose options are vectors of the worker's skills."""
    options = OptionTransform(worker, len(skills), 25, skills=skills)
    return TransformedEnv(WaterworldMazeEnv(mazes, observation=False), options)


def angles(moved: np.ndarray) -> list[float]:
    """Return the angles between the skills' directions, the smallest first (degrees)."""
    unit = moved / np.maximum(np.linalg.norm(moved, axis=-1, keepdims=True), 1e-9)
    cosines = [float(unit[i] @ unit[j]) for i, j in combinations(range(len(unit)), 2)]
    return sorted(float(np.degrees(np.arccos(np.clip(c, -1.0, 1.0)))) for c in cosines)


def measure(name: str, seed: int, base_steps: int, num_mazes: int) -> dict[str, Any]:
    """Train with an objective, plan over the skills in test mazes and execute the plans."""
    loss, seconds = train(RECIPES[name], seed, base_steps)
    worker = greedy(loss)
    moved, vectors = mean_displacements(worker, RECIPES[name]), RECIPES[name].options()
    made = {} if vectors is None else {"make_env": make_vector_env, "skills": vectors}
    lengths = np.linalg.norm(moved, axis=-1)
    return {
        "objective": name,
        "seed": seed,
        "train_base_steps": base_steps,
        "train_seconds": round(seconds, 1),
        "reward_scale": RECIPES[name].coeff,
        **solve(worker, num_mazes, seed, **made).summary(),
        "mean_displacements": moved.round(3).tolist(),
        "mean_displacement_length": round(float(lengths.mean()), 3),
        "smallest_length": round(float(lengths.min()), 3),
        "smallest_angle": round(angles(moved)[0], 1),
    }


def mean(runs: list[dict[str, Any]], key: str, part: str | None = None) -> float:
    return float(np.mean([run[key][part] if part else run[key] for run in runs]))


COLUMNS = {
    "objective": lambda runs: runs[0]["objective"],
    "seeds": len,
    "solved, by seed": lambda runs: ", ".join(f"{r['solved']}/{r['starts']}" for r in runs),
    "simulated steps, median": lambda runs: f"{mean(runs, 'simulated_steps', 'median'):,.0f}",
    "episode steps, median": lambda runs: f"{mean(runs, 'episode_steps', 'median'):.0f}",
    "smallest angle, by seed": lambda runs: ", ".join(f"{r['smallest_angle']:.0f}" for r in runs),
    "displacement, tiles": lambda runs: f"{mean(runs, 'mean_displacement_length'):.2f}",
    "training, s": lambda runs: f"{mean(runs, 'train_seconds'):.0f}",
}


def main() -> None:
    quick = {"seeds": [0], "mazes": 60}
    names = [name for name in RECIPES if not name.endswith("vectors")]
    args = read_arguments(__doc__, quick, seeds=[0], mazes=342, base_steps=40_000, objectives=names)
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in args.objectives}
    for name in args.objectives:
        for seed in args.seeds:
            runs[name].append(measure(name, seed, args.base_steps, args.mazes))
            print(json.dumps(runs[name][-1]), flush=True)
    write(args, [row for rows in runs.values() for row in rows])
    print("\n" + markdown(runs.values(), COLUMNS))


if __name__ == "__main__":
    main()
