"""
A manager that sets goals
=========================

The other way to be hierarchical, from the dissertation's chapter 3: the manager does not choose
what the worker does but where it should go. It searches the maze tile by tile, and its plan becomes
goals; the worker acts at every step and is paid for each goal it meets.
"""

# %%
# The worker's env
# ----------------
#
# ``make_goal_env`` puts a :class:`~torchrl_hmcts.transforms.SubgoalTransform` on the mazes: it
# plans at reset and whenever the worker has lost its way, shows the next three goals, and writes
# the worker's reward: 1 for a goal met, -1 for losing the way, a little less than 0 for every
# step.

from torchrl_hmcts.trainers import make_goal_env

env = make_goal_env(batch_size=[16], seed=0)
td = env.reset()
print("goals relative to the player:", [round(x, 2) for x in td["goals"][0].tolist()])
print("length of the plan:", td["plan_length"][0].item(), "tiles")

# %%
# What the manager does
# ---------------------
#
# It searches a Gridworld of the same maze, up, down, left, right, until no shorter path is
# possible: the plan is a shortest path in tiles.

import matplotlib.pyplot as plt
from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.trainers import make_starts, make_tile_planner

tests = make_goal_env(maze_pool("test"), observation=False)
mazes = tests.base_env
starts = make_starts(mazes, 40, seed=0)
far = int((starts["position"] - starts["target"]).norm(dim=-1).argmax())

manager = make_tile_planner(mazes)
goals, lengths = manager.plan_goals(starts[far : far + 1])
tree = manager.planner.last_search.tree
print(f"{int(lengths)} goals, the last at {goals[0, -1].tolist()}; {int(tree.num_nodes[0])} nodes")

figure, axes = plt.subplots(figsize=(4.8, 4.8), layout="constrained")
axes.imshow(
    ~mazes.mazes[int(starts["maze_index"][far])], cmap="gray", vmin=-0.15, extent=(0, 9, 9, 0)
)
tree.plot_positions(ax=axes, option_names=["up", "down", "left", "right", "none"], legend=False)
axes.set(xticks=[], yticks=[])
axes.spines[:].set(visible=True, linewidth=2.5)
plt.show()

# %%
# A worker that was not learned
# -----------------------------
#
# ``ScriptedExpert`` steers towards the next goal and slows down where the path turns. It shows
# what is possible, and whether the env is right, before anything is trained.

from torchrl_hmcts.trainers import ScriptedExpert, draw_goals, play_mazes

episodes = play_mazes(ScriptedExpert(), tests, starts, record=True)
summary = episodes.summary()
print(f"solved: {summary['solved_share']:.0%}; base steps, mean: {summary['base_steps_mean']:.0f}")

track = episodes.tracks[far]
last = len(track.positions) - 1
figure, panels = plt.subplots(1, 3, figsize=(11, 3.9), layout="constrained")
for axes, step in zip(panels, (0, last // 2, last), strict=True):
    axes.imshow(draw_goals(mazes, starts[far], track, step, tile_pixels=40))
    axes.set_title(f"base step {step}")
    axes.set_axis_off()
plt.show()

# %%
# A worker that learns
# --------------------
#
# Any TorchRL agent can be trained in this env. The dissertation's is A3C: asynchronous
# actor-learners (here one, in this process, so that the page can be built; ``num_learners=2``
# starts processes).
# To be quick, this worker reads no walls: its velocity and the goals, which lead around them.

from torchrl_hmcts.objectives import A3CLoss
from torchrl_hmcts.trainers import A3CTrainer, make_maze_networks

FRAMES = 60_000
actor, critic = make_maze_networks(
    make_goal_env(observation=False), in_keys=["velocity", "goals"], hidden=64, seed=0
)
loss = A3CLoss(actor, critic, entropy_coeff=0.01, critic_coeff=0.5, gamma=0.95)
short = make_goal_env(maze_pool("test"), observation=False, max_steps=300)
planned = short.reset(starts[:20].clone(), set_state=True)["plan_length"].sum()


def evaluate(policy):
    played = play_mazes(policy, short, starts[:20])
    goals_met = played.last["num_goals_met"].sum() / planned
    return {"solved": float(played.solved.double().mean()), "goals": float(goals_met)}


trainer = A3CTrainer(
    lambda: make_goal_env(batch_size=[32], observation=False),
    loss,
    total_frames=FRAMES,
    segment_steps=10,
    num_learners=0,
    lr=0.01,
    clip_norm=10.0,
    evaluate=evaluate,
    eval_interval=FRAMES // 4,
    seed=0,
)
history = trainer.train()

figure, axes = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
axes.plot(
    history["eval_frames"],
    history["eval_goals"],
    "o-",
    color="#1d4ed8",
    label="goals met, share of the plans",
)
axes.plot(
    history["eval_frames"],
    history["eval_solved"],
    "o-",
    color="#e66100",
    label="20 test mazes solved in 300 steps",
)
axes.set(xlabel="base steps of training", ylim=(-0.03, 1.03))
axes.grid(alpha=0.25)
axes.legend(frameon=False)
plt.show()
print(f"after {FRAMES:,} base steps: {history['eval_solved'][-1]:.0%} solved in 300 steps")

# %%
# That is a quarter of a minute of learning. With 2,000,000 base steps (ten minutes, ``hmcts train
# experiment=waterworld_goals``) the worker solves all 342 test mazes in each of three seeds, 14 %
# slower than the expert:
#
# .. image:: /results/goals/goal_agent.png
#    :alt: Test mazes solved, and base steps of an episode, while the worker learns
#
# :doc:`/algorithms/goal_based_agent` says how Algorithm 1 is read, and what is logged.

# sphinx_gallery_thumbnail_number = 2
