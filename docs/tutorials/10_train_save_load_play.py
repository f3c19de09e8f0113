"""
Train, save, load, play
=======================

An agent is a folder of JSON and plain arrays. Nothing in it can execute code.
"""

# %%
# Train and save
# --------------

import tempfile
from pathlib import Path

from torchrl_hmcts.trainers import HMCTS, load_worker

folder = Path(tempfile.mkdtemp()) / "car"
agent = HMCTS("MountainCar-v0", num_skills=4).learn(6_400, progress=False)
agent.save(folder)
print(sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()))

# %%
# Load and solve
# --------------
#
# In another process as well: the same start leads to the same plan.

again = HMCTS.load(folder)
print(again)
print(again.solve(seed=1) == agent.solve(seed=1))

# %%
# The folder is that of a run, as ``hmcts train kit=gym env.id=MountainCar-v0`` writes it. So all of
# these take it, and ``HMCTS.load`` takes the folders of ``hmcts demo`` and ``hmcts train`` too:
#
# .. code-block:: bash
#
#     hmcts play run=DIR                      # a window, or a page where there is no display
#     hmcts play run=DIR seed=3 out=car.mp4   # a film
#     hmcts evaluate run=DIR mazes=50         # fifty other starts
#
# The skills alone
# ----------------
#
# ``load_worker`` returns the skills as a TorchRL policy, for an env of your own: it reads the
# observation and ``"skill"``.

import torch
from tensordict import TensorDict

worker = load_worker(folder)
td = TensorDict(observation=torch.zeros(4, 2), skill=torch.arange(4), batch_size=[4])
print(worker.in_keys, worker(td)["action"].tolist())

# %%
# A film
# ------

import matplotlib.pyplot as plt

film = folder / "car.gif"
print(again.play(seed=1, out=film))
figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
axes.imshow(plt.imread(film))
axes.axis("off")
plt.show()
