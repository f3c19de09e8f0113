"""
From an id to a solved task
===========================

:class:`~torchrl_hmcts.trainers.HMCTS` is the agent in one line. It takes the id of a Gymnasium env,
makes it settable to any state, looks at it for about two thousand steps, and plans.
"""

# %%
# Reach a goal
# ------------

from torchrl_hmcts.trainers import HMCTS

agent = HMCTS("MountainCar-v0")
print(agent)
print(agent.kit.look)

# %%
# Without training, an option repeats one action. The look has found how many steps it should last:
# long enough to move the car by a tenth of what its position and velocity span. States closer than
# the *novelty radius* count as visited, which keeps the search small.
#
# ``solve`` plans in one instance of the env and executes the plan in another. Every step costs 1
# here, so the search continues for a while after its first plan, to find a shorter one.

solution = agent.solve(seed=0)
print(solution)
print("options:", solution.plan.options.tolist(), "in", int(solution.plan.durations), "base steps")

# %%
# The parts are the library's own: ``agent.env`` is the macro environment, an
# :class:`~torchrl_hmcts.envs.OptionPool`, and ``agent.planner`` the
# :class:`~torchrl_hmcts.planners.MCTSPlanner` over it. Its last search is still there: every place
# an option led to, and the way to the flag.

import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
search = agent.planner.last_search
search.tree.plot_positions(0, lambda states: states["features"], ax=axes)
axes.set(xlabel="position (share of its span)", ylabel="velocity (share of its span)")
plt.show()

# %%
# Collect rewards
# ---------------
#
# CartPole pays 1 for each step. The look notices that rewards come on the way, and the agent
# searches before every option instead of executing one plan.

agent = HMCTS("CartPole-v1", search_steps=300, make={"max_episode_steps": 120})
print(agent.kit.look)
print(agent.solve(seed=0))

# %%
# Change what was found
# ---------------------
#
# All that the look finds is a key: ``option_steps``, ``novelty_radius``, ``task``. Parts of the
# planner go by the names of their classes, as in :doc:`/kits`.

puct = {"tree_policy": {"_component_": "torchrl_hmcts.planners.PUCT", "c": 2.0}}
agent = HMCTS("MountainCar-v0", option_steps=10, novelty_radius=0.05, planner=puct)
print(agent.planner.tree_policy, agent.solve(seed=0).solved)

# %%
# What cannot be planned in says why.

try:
    HMCTS("MountainCa-v0")
except ValueError as error:
    print(error)
