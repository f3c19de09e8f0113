"""
In a notebook
=============

What Jupyter shows of agents, plans, searches and envs, and what it says to slips.
"""

# %%
# ``import torchrl_hmcts`` is enough to begin: Tab lists the shortcuts and the packages, and in each
# package every public name. Nothing is loaded before it is used.

import torchrl_hmcts

print(dir(torchrl_hmcts))
print(len(dir(torchrl_hmcts.trainers)), "names in trainers, e.g.", dir(torchrl_hmcts.trainers)[:3])

# %%
# Plans, searches and agents
# --------------------------
#
# The last line of a cell shows an object by its picture: a plan as a strip of options, a search as
# its tree, an env as its first maze. This page shows the same pictures.

import matplotlib.pyplot as plt
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl_hmcts import MCTSPlanner, OptionTransform, RadiusNovelty, WaterworldMazeEnv

worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
env = TransformedEnv(WaterworldMazeEnv(seed=0), OptionTransform(worker, 4, max_steps=20))
planner = MCTSPlanner(env, novelty=RadiusNovelty("position", 0.6), seed=0)
plan = planner.plan(env.reset())
print(plan)
print(planner.last_search)
print(planner)

# %%
# Without a figure of yours, ``plot_positions`` draws the map of an env that has one, the right way
# up.

planner.last_search.tree.plot_positions(option_names=["up", "down", "left", "right"])
plt.show()

# %%
# Slips
# -----
#
# What is written wrong is answered by what to write.

from torchrl_hmcts.planners import UCT

for attempt in (
    lambda: planner.plan(env),
    lambda: MCTSPlanner(env, tree_policy=UCT),
    lambda: MCTSPlanner(env, novelty="radius"),
    lambda: MCTSPlanner(env, num_simulations=100),
    lambda: MCTSPlanner(env).last_search,
):
    try:
        attempt()
    except (TypeError, RuntimeError) as error:
        print(f"{type(error).__name__}: {error}")
