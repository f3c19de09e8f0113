"""
Bring your own simulator
========================

A planner needs an env that it can set to any state. Two kinds can: *stateless* envs, whose state is
in the tensordict, and envs that restore one on ``reset(td, set_state=True)``. This page plans in
one of each that was not written for this project: TorchRL's pendulum, and a Gymnasium env.
"""

# %%
# TorchRL's PendulumEnv
# ---------------------
#
# It is stateless, so nothing is to be done. Its action, a torque, is continuous; options make it
# discrete: full torque one way, none, full torque the other way, each held for 6 steps (0.3 s).
# No torque lifts the pendulum by itself, it must swing.

import math

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import PendulumEnv, TransformedEnv
from torchrl_hmcts.planners import UCT, HighestValue, MCTSPlanner, SearchBudget
from torchrl_hmcts.transforms import OptionTransform

torque = torch.tensor([[-2.0], [0.0], [2.0]])
hold = TensorDictModule(lambda skill: torque[skill], ["skill"], ["action"])


def make_pendulum():
    return TransformedEnv(PendulumEnv(), OptionTransform(hold, 3, max_steps=6, gamma=0.99))


env = make_pendulum()
start = env.reset()
start["th"], start["thdot"] = torch.tensor(math.pi), torch.tensor(0.0)  # hanging down
start = env.reset(start, set_state=True)

# %%
# All rewards are costs, up to 16 a step. So ``UCT`` explores in that unit, the backup is the
# largest value (the pendulum is deterministic), the choice is the option of highest value, and
# the search does not stop at a "first reward".

planner = MCTSPlanner(
    make_pendulum(),
    tree_policy=UCT(c=5.0),
    backup="max",
    final_choice=HighestValue(),
    budget=SearchBudget(expansions=20, until_plan=False),
    leaves_per_wave=10,
    seed=0,
)
planned = env.rollout(18, planner, tensordict=start.clone(), auto_reset=False, set_state=True)
random = env.rollout(18, tensordict=start.clone(), auto_reset=False, set_state=True)

import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
seconds = 0.3 * torch.arange(1, 19)
axes.plot(seconds, planned["next", "th"].cos(), "o-", color="#1d4ed8", label="planned")
axes.plot(seconds, random["next", "th"].cos(), "o-", color="#b9c4d6", label="random options")
axes.set(xlabel="seconds", ylabel="height of the tip", ylim=(-1.1, 1.1))
axes.grid(alpha=0.25)
axes.legend(frameon=False)
plt.show()

# %%
# A Gymnasium env
# ---------------
#
# TorchRL's ``GymEnv`` cannot set a state, as Gymnasium has no call for it; but most simulators
# have a way: ``env.unwrapped.state`` in classic control, ``set_state(qpos, qvel)`` in MuJoCo,
# ``restoreState`` in Atari (:doc:`/atari`). Three things are to be added: declare the state,
# write it after every step and reset, and restore it when asked.

from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import GymEnv


class SettableAcrobot(GymEnv):
    """Two links, driven at the joint between them: swing the tip above the line."""

    _supports_set_state = True

    def __init__(self, **kwargs):
        super().__init__("Acrobot-v1", categorical_action_encoding=True, **kwargs)
        self.observation_spec["state"] = Unbounded(4, dtype=torch.float64)
        self.state_spec["state"] = self.observation_spec["state"].clone()

    def _read_state(self, td):
        return td.set("state", torch.as_tensor(self._env.unwrapped.state))

    def _reset(self, tensordict=None, set_state=False, **kwargs):
        out = super()._reset(tensordict, **kwargs)
        if set_state:
            self._env.unwrapped.state = tensordict["state"].numpy().copy()
            out["observation"] = torch.as_tensor(self._env.unwrapped._get_ob())
        return self._read_state(out)

    def _step(self, tensordict):
        return self._read_state(super()._step(tensordict))


# %%
# Is it right? Set to a state and stepped, the env must give what the unbroken run gave:

torch.manual_seed(0)
acrobot = SettableAcrobot()
acrobot.set_seed(0)
run = acrobot.rollout(30)
again = SettableAcrobot()
again.reset()
before = again.reset(TensorDict({"state": run["state"][20]}), set_state=True)
after = again.step(before.set("action", run["action"][20]))
print("the same next state:", torch.equal(after["next", "state"], run["next", "state"][20]))

# %%
# Plan in it. Options hold a torque for up to 8 steps. The reward is -1 a step until the tip is
# above the line, so again every reward is a cost; what guides the search is a leaf evaluator: the
# height of the tip, and how much swing there is.

push = TensorDictModule(lambda skill: 2 * skill, ["skill"], ["action"])  # torque -1 or +1


def make_acrobot():
    return TransformedEnv(SettableAcrobot(), OptionTransform(push, 2, max_steps=8, gamma=0.99))


def energy(td):
    cos1, sin1, cos2, sin2, speed1, speed2 = td["observation"].unbind(-1)
    height = -cos1 - (cos1 * cos2 - sin1 * sin2)
    return -60.0 + 10.0 * height + 0.6 * speed1.square() + 0.3 * speed2.square()


planner = MCTSPlanner(
    make_acrobot(),
    tree_policy=UCT(c=10.0),
    leaf_evaluator=energy,
    backup="max",
    final_choice=HighestValue(),
    budget=SearchBudget(expansions=8, until_plan=False),
    seed=0,
)
env = make_acrobot()
env.set_seed(0)
torch.manual_seed(0)
episode = env.rollout(25, planner)
steps = int(episode["next", "duration"].sum())
print("reached the line:", bool(episode["next", "terminated"][-1]), "after", steps, "base steps")

# %%
# The links at the end of each option, light to dark:


def links(state):
    a, b = float(state[0]), float(state[0] + state[1])
    elbow = (math.sin(a), -math.cos(a))
    return [0, elbow[0], elbow[0] + math.sin(b)], [0, elbow[1], elbow[1] - math.cos(b)]


figure, axes = plt.subplots(figsize=(4.6, 4.6), layout="constrained")
states = torch.cat((episode["state"][:1], episode["next", "state"]))
for i, state in enumerate(states):
    shade = 0.15 + 0.85 * i / (len(states) - 1)
    axes.plot(*links(state), "o-", color=plt.cm.Blues(shade), linewidth=2.5)
axes.axhline(1.0, color="#16a34a", linestyle="--")
axes.set(aspect="equal", xlim=(-2.1, 2.1), ylim=(-2.1, 2.1), xticks=[], yticks=[])
plt.show()

# %%
# An env with a state of its own is stepped for one node after the other, so a search takes its
# steps one by one. If you can, make the env stateless and batched: :doc:`01_options_in_ten_lines`
# has one in thirty lines. Or use processes, as :class:`~torchrl_hmcts.envs.AtariOptionPool` does.
# If nothing can be set, as with a robot, plan in a model that was learned: :doc:`/skills`.
