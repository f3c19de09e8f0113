"""
Plan in MiniGrid
================

A door is locked, and the key lies somewhere else. No step is rewarded but the last. (Needs
``pip install 'torchrl_hmcts[gym]'``.)
"""

# %%
# One line
# --------

from torchrl_hmcts.trainers import HMCTS

agent = HMCTS("MiniGrid-DoorKey-8x8-v0")
solution = agent.solve(seed=0)
print(agent)
print(solution)

# %%
# What makes it quick
# -------------------
#
# - *Options*: go one cell right, down, left or up; pick up, drop, toggle, done
#   (:class:`~torchrl_hmcts.envs.GridMoves`), each only where it changes something
#   (:class:`~torchrl_hmcts.envs.GridView`).
# - *Novelty*: the agent's pose is paired with each thing that can change
#   (:class:`~torchrl_hmcts.envs.GridFeatures`): what is carried, each door, each object. A state
#   is kept if one of its pairs is new. So "here with the key" is not "here without it".

for name, part in agent.planner.settings.__dict__.items():
    if name in ("novelty", "leaves_per_wave", "tree_policy"):
        print(f"{name:16} {part}")
novelty = agent.planner.last_search.novelty
print(novelty.statistics())

# %%
# The episode, drawn by the env itself
# ------------------------------------

import matplotlib.pyplot as plt

names = "right down left up pick-up drop toggle done".split()
print(" ".join(names[option] for option in solution.plan.options.tolist()))
start = agent.start(seed=0)
episode = agent.kit.film(agent.worker, agent.planner, start, render="rgb_array")
shown = [episode.frames[int(i)] for i in (0, len(episode.frames) // 2, len(episode.frames) - 1)]
figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
for panel, frame in zip(axes, shown, strict=True):
    panel.imshow(frame)
    panel.axis("off")
plt.show()
