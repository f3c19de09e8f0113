"""
Option length and novelty radius
================================

Two numbers decide whether a search over options finds a plan: how long an option lasts, and within
which radius a place counts as visited. This page shows both too small, right, and too large.
"""

# %%
# Twelve mazes
# ------------
#
# Four options hold thrust in one direction. All searches have the same budget: 6,000 base steps of
# simulation for each maze.

import matplotlib.pyplot as plt
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl_hmcts import MCTSPlanner, OptionTransform, RadiusNovelty, WaterworldMazeEnv
from torchrl_hmcts.planners import SearchBudget

BUDGET = SearchBudget(base_steps=6_000)
worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])


def make_env(option_steps):
    options = OptionTransform(worker, num_options=4, max_steps=option_steps)
    return TransformedEnv(WaterworldMazeEnv(observation=False, seed=0), options)


def search(option_steps, radius):
    novelty = None if radius is None else RadiusNovelty("position", radius)
    planner = MCTSPlanner(make_env(option_steps), novelty=novelty, budget=BUDGET, seed=0)
    return planner.search(starts)


starts = make_env(20).reset(TensorDict(batch_size=[12]))


def report(name, values, searches):
    print(f"{name:>12}  plans found  simulated base steps, median")
    for value, found in zip(values, searches, strict=True):
        cost = sorted(found.num_base_steps.tolist())[6]
        print(f"{str(value):>12}  {int((found.best_node >= 0).sum()):2} of 12      {cost:,}")


def draw(values, searches, name):
    figure, panels = plt.subplots(1, 3, figsize=(10, 3.6), layout="constrained")
    for axes, value, found, words in zip(
        panels, values, searches, ("too small", "right", "too large"), strict=True
    ):
        found.tree.draw_map(axes, found.tree.states[shown, 0])
        found.tree.plot_positions(shown, ax=axes, legend=False, max_nodes=400)
        axes.set_title(f"{words}: {name} {value}", loc="left")
    plt.show()


# %%
# The length of an option
# -----------------------
#
# Short options move too little. A search sees only a limited number of options ahead, and most of
# them end within the novelty radius of their start. Long options are few and coarse: they run past
# side ways, and every one costs its whole length.

lengths = [4, 20, 160]
by_length = [search(steps, 0.6) for steps in lengths]
shown = int((by_length[2].best_node < 0).argmax())  # a maze that the longest options do not solve
report("option steps", lengths, by_length)
draw(lengths, by_length, "option steps")

# %%
# **To choose it:** long enough that one option crosses a doorway or a tile, short enough that it
# does not pass two turnings. ``HMCTS(id)`` measures it: it repeats actions for longer and longer
# until a quarter of the options has moved the features by a twelfth of their span. ``print(agent)``
# says what it found, ``HMCTS(id, option_steps=14)`` sets it.
#
# The radius
# ----------
#
# With too small a radius almost nothing is refused. The search spends its budget on places that are
# nearly the same. With too large a radius everything in reach is soon refused. Then the radius
# shrinks, by a quarter each time, until something is new again. So in these mazes the search still
# finds its plans, and cheaply. But it has less choice: of several ways to a place it keeps the
# first. A test that cannot shrink, such as one of your own without ``relax``, would end without a
# plan.

radii = [0.1, 0.6, 5.0]
by_radius = [search(20, radius) for radius in radii]
report("radius", radii, by_radius)
draw(radii, by_radius, "radius")

# %%
# **To choose it:** about half of the way that one option makes, and rather larger than smaller.
# ``HMCTS(id)`` takes half of what repeated actions move the
# features, and three quarters of what learned skills do.
#
# Both numbers scale with each other: options twice as long go with a radius twice as large. When no
# plan is found, draw the search (``planner.last_search.tree.plot_positions()``) and look which of
# the pictures above it resembles.

# sphinx_gallery_thumbnail_number = 1
