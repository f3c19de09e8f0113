"""
Skills in TorchRL's SACTrainer
==============================

DIAYN (Eysenbach et al., 2018, arXiv 1802.06070) learns skills without a reward: a discriminator
guesses which skill was followed, and the policy is paid for being guessed. To a TorchRL script that
is two transforms and a loss; the rest stays as it was.
"""

# %%
# An env with skills
# ------------------
#
# ``SkillTransform`` draws one of four skills, and another every 50 steps.
# ``DisplacementTransform`` writes how far the disc has moved since. The entry that the
# discriminator reads decides what "different" means; here skills are to be directions.

import torch
from torchrl.envs import Compose, TransformedEnv
from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform

NUM_SKILLS = 4
torch.manual_seed(1)
env = TransformedEnv(
    WaterworldMazeEnv(observation=False, batch_size=[32], max_steps=400, seed=1),
    Compose(SkillTransform(NUM_SKILLS, max_skill_steps=50), DisplacementTransform()),
)

# %%
# The loss
# --------
#
# TorchRL's soft actor-critic, conditioned on the skill, and the discriminator's loss beside it.
# Actor and critics have two layers that all skills share, and a head for each. The actor sees
# only the velocity, so that a skill means the same in every maze.

from torchrl_hmcts.modules import SkillActor, SkillCritic, SkillDiscriminator
from torchrl_hmcts.objectives import DIAYNLoss

actions = env.action_spec_unbatched
loss = DIAYNLoss(
    SkillActor(2, actions, NUM_SKILLS, in_keys=["velocity"]),
    SkillCritic(4, num_actions=4, num_skills=NUM_SKILLS, in_keys=["velocity", "displacement"]),
    SkillDiscriminator(2, NUM_SKILLS, in_keys=["displacement"]),
    action_space=actions,
)

# %%
# TorchRL's trainer
# -----------------
#
# ``SkillReward`` on the replay buffer rewards sampled transitions by the present discriminator, so
# old transitions have no stale rewards. ``make_skill_optimizer`` is an Adam with a learning rate
# for each part; any optimiser will do.

from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import SoftUpdate
from torchrl.trainers.algorithms import SACTrainer
from torchrl_hmcts.trainers import make_skill_optimizer
from torchrl_hmcts.transforms import SkillReward

FRAMES = 16_000
trainer = SACTrainer(
    collector=Collector(
        env,
        loss.actor_network,
        frames_per_batch=64,
        total_frames=FRAMES,
        auto_register_policy_transforms=False,
    ),
    total_frames=FRAMES,
    frame_skip=1,
    optim_steps_per_batch=3,
    loss_module=loss,
    optimizer=make_skill_optimizer(loss),
    replay_buffer=ReplayBuffer(
        storage=LazyTensorStorage(20_000), transform=SkillReward(loss.objective), batch_size=256
    ),
    batch_size=256,
    target_net_updater=SoftUpdate(loss, tau=0.05),
    progress_bar=False,
    enable_logging=False,
)

# %%
# A hook of the trainer keeps the curves (``DIAYNTrainer``, the recipe of this project, logs them
# by the names of the dissertation's figures):

curves = {}


def keep(optim_steps, average_losses):
    for name, value in average_losses.items():
        curves.setdefault(name, []).append(float(value))


trainer.register_op("post_optim_complete_log", keep)
trainer.train()
print(
    f"discriminator's accuracy at the end: {sum(curves['discriminator_accuracy'][-20:]) / 20:.2f}"
)

# %%
# What was learned
# ----------------
#
# Ten mini-episodes of every skill from the middle of an open room. They fan out in different
# directions, although no reward says what a direction is.

import matplotlib.pyplot as plt
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import option_color

room = WaterworldMazeEnv(torch.zeros(1, 9, 9, dtype=torch.bool), observation=False)
policy = SkillPolicy(loss.actor_network)  # the same parameters, lean
skills = torch.arange(NUM_SKILLS).repeat_interleave(10)
td = room.make_state(torch.zeros_like(skills), (4.5, 4.5), (0.5, 8.5))
points = [td["position"]]
for _ in range(60):
    td = room.step(policy(td.set("skill", skills)))["next"].exclude("reward")
    points.append(td["position"])

figure, (left, right) = plt.subplots(
    1, 2, figsize=(9.5, 4), layout="constrained", width_ratios=(1, 1.3)
)
for skill, track in zip(skills.tolist(), torch.stack(points, 1), strict=True):
    left.plot(*track.T, color=option_color(skill), linewidth=1.3, alpha=0.7)
left.set(
    xlim=(0, 9), ylim=(9, 0), xticks=[], yticks=[], aspect="equal", title="skills, one colour each"
)
left.spines[:].set(visible=True, linewidth=2.5)
steps = torch.linspace(0, FRAMES, len(curves["loss_discriminator"]))
right.plot(steps, curves["loss_discriminator"], color="#1d4ed8", label="discriminator's loss")
right.plot(steps, curves["discriminator_accuracy"], color="#e66100", label="its accuracy")
right.set(xlabel="base steps", ylim=(0, 1.5), title="training")
right.grid(alpha=0.25)
right.legend(frameon=False)
plt.show()

# %%
# Plan with them
# --------------
#
# The skills are options now. ``maze_pool("test")`` are mazes that were not trained in.

from tensordict import TensorDict
from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.transforms import OptionTransform

worker = SkillPolicy(loss.actor_network, deterministic=True)
macro = TransformedEnv(
    WaterworldMazeEnv(maze_pool("test"), observation=False, seed=0),
    OptionTransform(worker, NUM_SKILLS, max_steps=25),
)
planner = MCTSPlanner(
    macro, novelty=RadiusNovelty("position", 1.0), budget=SearchBudget(expansions=300), seed=0
)
plans = planner.plan(macro.reset(TensorDict(batch_size=[20])))
print(f"plans found in test mazes: {int(plans.found.sum())} of 20")

# %%
# So few steps are not always enough: with seed 0 two of the four skills were still one after
# 16,000 steps, and only 7 plans were found. For serious runs take
# :class:`~torchrl_hmcts.trainers.DIAYNTrainer` with its 40,000: the same as a recipe, with settings
# that work in these mazes, curves, and checkpoints that resume to the bit.
# :doc:`/algorithms/diayn` has its figures over three seeds and three lengths of training.
