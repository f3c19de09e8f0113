"""
Plan in MuJoCo
==============

A ball rolls through a maze of gymnasium-robotics. Its state is more than positions and velocities;
the snapshot stores all of it, so that a plan that works in the simulator works in the env. (Needs
``pip install 'torchrl_hmcts[gym]'``.)
"""

# %%
# Without training
# ----------------
#
# Eight options push in eight directions.

import matplotlib.pyplot as plt
from torchrl_hmcts.trainers import HMCTS

agent = HMCTS("PointMaze_Large-v3")
print(agent)
print(agent.solve(seed=0))


def show(agent, title):
    figure, axes = plt.subplots(figsize=(6, 4.4), layout="constrained")
    tree = agent.planner.last_search.tree
    tree.plot_positions(0, lambda states: states["features"], ax=axes, legend=False)
    axes.set_aspect("equal")
    axes.set_title(title)
    plt.show()


show(agent, "options that push in one direction")

# %%
# Learn skills
# ------------
#
# ``learn`` trains skills without any reward (DIAYN): each should be recognised by how it moves the
# ball. A minute is enough here; :class:`~torchrl_hmcts.trainers.DIAYNTrainer` does it, over 16
# copies of the env. ``objective=`` takes METRA, LSD or DADS instead.

agent.learn(6_400, progress=False)
print(agent)
print("novelty radius", round(agent.config.novelty_radius, 2))
print(agent.solve(seed=0))
show(agent, "learned skills")

# %%
# Faster physics
# --------------
#
# The agent searches through :class:`~torchrl_hmcts.envs.OptionPool`, which runs whole options in a
# plain loop over the Gymnasium env. :class:`~torchrl_hmcts.envs.MujocoBatch` steps many states of a
# maze at once in C; it is a TorchRL env and goes under an ``OptionTransform`` as any other.

import torch
from torchrl_hmcts.envs import MujocoBatch

env = MujocoBatch("PointMaze_Large-v3", batch_size=[64], seed=0)
rollout = env.rollout(20, lambda td: td.set("action", torch.ones(64, 2)))
print(rollout["next", "position"][:, -1].std(0))
