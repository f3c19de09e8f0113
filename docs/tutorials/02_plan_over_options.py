"""
Plan over your own options
==========================

Give a planner a handful of behaviours, and it finds how to string them together. Here: random
mazes, four behaviours that need no training, and a tree search over them.
"""

# %%
# A maze, and four options
# ------------------------
#
# ``WaterworldMazeEnv`` is a maze of 9 by 9 tiles with the physics of a disc in water: thrust
# accelerates it, it slides along walls, and it has to reach the green target. The reward is 1
# there and 0 everywhere else.
#
# Our options hold thrust in one of the four directions for 20 base steps, one second. The worker
# could be anything that reads the option: a controller, a script, a network.

from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.transforms import OptionTransform

OPTIONS = ["up", "down", "left", "right"]
worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])


def make_env(max_steps=20):
    options = OptionTransform(worker, num_options=4, max_steps=max_steps, gamma=0.99)
    return TransformedEnv(WaterworldMazeEnv(observation=False, seed=0), options)


env = make_env()
starts = env.reset(TensorDict(batch_size=[20]))  # 20 mazes
distance = (starts["position"] - starts["target"]).norm(dim=-1)
start = starts[int(distance.argmax())]  # of which this one has the longest way

# %%
# Search
# ------
#
# The planner gets an env of its own, as the simulator in which it looks ahead. ``RadiusNovelty``
# is what makes a search in continuous space finite: a place within 0.6 tiles of one that is in
# the tree already is not searched again.

from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty

planner = MCTSPlanner(make_env(), novelty=RadiusNovelty("position", 0.6), seed=0)
plan = planner.plan(start)
length = int(plan.lengths)
print("the plan:", [OPTIONS[o] for o in plan.options[:length].tolist()])

search = planner.last_search
print(search.tree.summary(option_names=OPTIONS))

# %%
# Where the options led in the maze, and the tree they form: an edge has its option's colour, grey
# crosses were refused by the novelty test, and the plan lies on a yellow band.

import matplotlib.pyplot as plt


def draw_maze(axes, maze, target):
    height, width = maze.shape
    axes.imshow(~maze, cmap="gray", vmin=-0.15, extent=(0, width, height, 0))
    axes.plot(*target.tolist(), "o", color="#16a34a", markersize=11)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(visible=True, linewidth=2.5)


figure, (left, right) = plt.subplots(
    1, 2, figsize=(11, 5), layout="constrained", width_ratios=(1, 1.2)
)
draw_maze(left, env.base_env.mazes[int(start["maze_index"])], start["target"])
search.tree.plot_positions(ax=left, option_names=OPTIONS, legend=False)
search.tree.plot(ax=right, option_names=OPTIONS, max_nodes=250)
plt.show()

# %%
# Execute the plan
# ----------------
#
# The planner is a policy: it reads a state and writes the option to take. ``HierarchicalPolicy``
# executes a plan to its end before it plans again, so the whole agent is one ``rollout`` of
# TorchRL.

from torchrl_hmcts.planners import HierarchicalPolicy

agent = HierarchicalPolicy(planner)
episode = env.rollout(50, policy=agent, tensordict=start.clone(), auto_reset=False, set_state=True)
print("options:", [OPTIONS[o] for o in episode["option"].tolist()])
print("base steps:", int(episode["next", "duration"].sum()))
print("solved:", bool(episode["next", "terminated"][-1]))

# %%
# The same, base step by base step, drawn by the env:

shown = TransformedEnv(
    WaterworldMazeEnv(observation=False, seed=0),
    OptionTransform(worker, 4, 20, gamma=0.99, trajectory_keys=["position"]),
)
steps = shown.rollout(50, policy=agent, tensordict=start.clone(), auto_reset=False, set_state=True)
mask = steps["next", "trajectory", "mask"]
track = steps["next", "trajectory", "position"][mask]

figure, axes = plt.subplots(figsize=(4.2, 4.2), layout="constrained")
picture = env.base_env.render(start, paths=[(track.numpy(), (37, 99, 235))], tile_pixels=48)
axes.imshow(picture)
axes.set_axis_off()
plt.show()

# %%
# Many mazes at once
# ------------------
#
# A batch of states is searched side by side, with one call of the simulator for all trees. Each
# tree is the same as if it had been searched alone.

plans = planner.plan(starts)
cost = sorted(planner.last_search.num_base_steps)
print(f"plans found: {int(plans.found.sum())} of 20; simulated base steps, median: {cost[10]:,}")

# %%
# What the novelty test is worth
# ------------------------------
#
# The radius has to fit the options: below one option's motion (about 1.5 tiles here), well above
# nothing. When everything in reach has been refused, the radius shrinks by itself; that costs
# simulation, but the search does not give up.

from torchrl_hmcts.planners import SearchBudget

radii = [None, 0.15, 0.3, 0.6, 1.2]
costs, found = [], []
for radius in radii:
    novelty = None if radius is None else RadiusNovelty("position", radius)
    test = MCTSPlanner(make_env(), novelty=novelty, budget=SearchBudget(expansions=100), seed=0)
    found.append(int(test.plan(starts).found.sum()))
    costs.append(sorted(test.last_search.num_base_steps.tolist()))

figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.4), layout="constrained")
labels = ["none" if radius is None else str(radius) for radius in radii]
left.bar(labels, found, color="#1d4ed8", width=0.6)
left.set(
    title="plans found for 20 mazes, 100 expansions each",
    xlabel="radius of the novelty test, tiles",
    ylim=(0, 20.5),
)
right.boxplot(
    costs, tick_labels=labels, whis=(5, 95), showfliers=False, medianprops={"color": "#d51178"}
)
right.set(
    title="simulated base steps per search",
    xlabel="radius of the novelty test, tiles",
    ylim=(0, None),
)
for axes in (left, right):
    axes.grid(alpha=0.25, axis="y")
plt.show()

# %%
# What to read next: :doc:`/planning` has every part of the planner,
# :doc:`/algorithms/mcts_over_options` what it computes, and
# :doc:`04_swap_the_parts` exchanges some of them.

# sphinx_gallery_thumbnail_number = 1
