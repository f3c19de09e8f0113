"""
Why an untrained worker already solves mazes
============================================

A search over skills solves some mazes before anything was learned. This page shows why, and what
training adds. So "solved" alone is no proof of learning: set the untrained worker beside it.
"""

# %%
# What untrained skills do
# ------------------------
#
# A worker is a network that reads the velocity and the skill. Before training its weights are
# random. But the skill is one of its inputs, so each skill prefers other thrusts. From the same
# place, different skills lead to different places. A tree search needs nothing more. Trained skills
# do the same more reliably: each is a straight direction.

import matplotlib.pyplot as plt
import torch
from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import option_color
from torchrl_hmcts.trainers import DIAYNTrainer, make_training_env

base = WaterworldMazeEnv(torch.zeros(1, 9, 9, dtype=torch.bool), observation=False)  # no walls
middle, corner = torch.full((4, 2), 4.5), torch.full((4, 2), 0.5)


def worker(train_base_steps, seed):
    env = make_training_env(num_skills=4)
    loss = DIAYNTrainer.make_loss(env, num_skills=4, seed=seed)
    if train_base_steps:
        DIAYNTrainer(env, loss, total_frames=train_base_steps, seed=seed).train()
    return SkillPolicy(loss.actor_network, deterministic=True)


def draw_skills(axes, policy, title):
    td = base.make_state(torch.zeros(4, dtype=torch.long), middle, corner)
    way = [td["position"]]
    for _ in range(25):
        td = base.step(policy(td.set("skill", torch.arange(4))))["next"].exclude("reward")
        way.append(td["position"])
    for skill, line in enumerate(torch.stack(way, 1)):
        axes.plot(*line.T, color=option_color(skill), linewidth=2.5)
        axes.annotate(str(skill), line[-1], color=option_color(skill), weight="bold")
    axes.set(xlim=(2, 7), ylim=(7, 2), aspect="equal", xticks=[], yticks=[])
    axes.set_title(title, loc="left")


figure, panels = plt.subplots(1, 4, figsize=(11, 3.1), layout="constrained")
for axes, seed in zip(panels, (0, 1, 2), strict=False):
    draw_skills(axes, worker(0, seed), f"untrained, seed {seed}")
draw_skills(panels[3], worker(9_984, 0), "9,984 steps, seed 0")
plt.show()

# %%
# How many mazes that solves
# --------------------------
#
# ``benchmarks/ablations.py`` ran the same search in the same fifty mazes: with ten networks that
# were never trained, with three that were, and with a worker by rule, whose options repeat one of
# the four thrusts.

import json
from pathlib import Path

file = next(Path.cwd().glob("**/results/ablations.json"), None)
file = file or Path("../results/ablations.json")
rows = [r for r in json.loads(file.read_text())["rows"] if r["task"] == "maze"]
for arm in ("untrained", "DIAYN, 40,960 base steps", "hand-written"):
    solved = [sum(r["solved"]) for r in rows if r["arm"] == arm and r["table"] == "worker"]
    print(f"{arm:>24}: {', '.join(map(str, solved))} of 50")

# %%
# What training adds
# ------------------
#
# - **It works for more seeds.** With one seed the untrained skills reach everything, with another
#   two of them are nearly the same and most of the mazes stay unsolved. Training ends well more
#   often, but not always: skills keep changing, and the last ones need not be the best. With
#   ``curve_points=10`` a run tests skills on the way in other mazes and keeps the best; then all
#   three seeds solve all mazes.
# - **It matters more where actions are far from motion.** In Waterworld an action is a thrust, and
#   to repeat one is as good as a trained skill. In DeepMind Lab's maze a key turns the player or
#   pushes it. An ant cannot walk before it has learned to: of five starts in OGBench's antmaze the
#   untrained worker solves none.
# - **A body that must turn needs training.** With ``task=boat`` no single action, held for long,
#   leads through a maze. The best of ten untrained workers solves barely more than half of the
#   mazes.
#
# So read each "solved" on these pages beside its baseline; :doc:`/ablations` leaves out the other
# parts as well. :doc:`12_option_length` shows how much
# the options' length and the novelty radius contribute, :doc:`/results/README` has the data.
