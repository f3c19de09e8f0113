r"""
Options in ten lines
====================

Put options on an env of your own, and let TorchRL's losses learn over them: correctly, although
options take different times.

An *option* is a behaviour that lasts several steps (Sutton, Precup and Singh, 1999). Over options,
an env is a semi-Markov decision process: one step takes :math:`k` base steps, and what follows it
counts :math:`\gamma^k` instead of :math:`\gamma`.
"""

# %%
# An env of your own
# ------------------
#
# Here it is a car in a valley, too weak to drive out of it: it has to swing. There is no reward
# before the top. The env is a plain TorchRL env; nothing in it knows of options. (It keeps its
# state in the tensordict, so that any number of cars can be stepped at once. An env that keeps
# its state to itself, such as a ``GymEnv``, can be wrapped in the same way.)

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase


class ValleyEnv(EnvBase):
    batch_locked = False  # the state is in the tensordict
    _supports_set_state = True  # reset(td, set_state=True) continues from td

    def __init__(self):
        super().__init__()
        self.observation_spec = Composite(car=Unbounded(2))  # position, velocity
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Categorical(2)  # push to the left, to the right
        self.reward_spec = Unbounded(1)
        self.done_spec = Composite(
            done=Binary(1, dtype=torch.bool), terminated=Binary(1, dtype=torch.bool)
        )

    def _reset(self, td=None, set_state=False, **kwargs):
        shape = () if td is None else td.batch_size
        if set_state:
            car = td["car"]
        else:
            car = torch.stack((torch.rand(shape) * 0.2 - 0.6, torch.zeros(shape)), -1)
        return TensorDict({"car": car}, shape)

    def _step(self, td):
        x, v = td["car"].unbind(-1)
        v = (v + 0.001 * (2 * td["action"] - 1) - 0.0025 * torch.cos(3 * x)).clamp(-0.07, 0.07)
        x, v = (x + v).clamp(-1.2, 0.6), v * (x + v > -1.2)
        top = (x >= 0.5).unsqueeze(-1)
        return TensorDict(
            {"car": torch.stack((x, v), -1), "reward": top.float(), "done": top, "terminated": top},
            td.batch_size,
        )

    def _set_seed(self, seed):
        torch.manual_seed(seed)


# %%
# The ten lines
# -------------
#
# A *worker* executes options: it reads the option that runs (``"skill"``) and all else that it
# needs, and writes the action. Option 0 pushes to the left, option 1 to the right, each until the
# car comes to rest or 50 steps have passed.

from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl_hmcts.transforms import OptionTransform

worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])


def at_rest(td):
    return (td["duration"] > 4) & (td["car"][..., 1:].abs() < 0.002)


env = TransformedEnv(
    ValleyEnv(),
    OptionTransform(worker, num_options=2, max_steps=50, gamma=0.99, termination=at_rest),
)

# %%
# That is all. One step of ``env`` is now one option; ``duration`` is how many base steps it took,
# and the reward is
# :math:`\sum_{i<k} \gamma^i r_{i+1}`.

torch.manual_seed(0)
episodes = env.rollout(
    25,
    tensordict=env.reset(TensorDict(batch_size=[200])),
    auto_reset=False,
    break_when_any_done=False,
)
print("options that were drawn:", episodes["option"][0, :8].tolist())
print("base steps they took:   ", episodes["next", "duration"][0, :8, 0].tolist())

# %%
# Why options
# -----------
#
# Drawn at random, actions leave the car in the valley. Options drawn at random get it out now and
# then, which is all that a learner needs.

import matplotlib.pyplot as plt

base = ValleyEnv()
shown = TransformedEnv(  # the same options, and the base steps they consist of
    ValleyEnv(),
    OptionTransform(worker, 2, 50, gamma=0.99, termination=at_rest, trajectory_keys=["car"]),
)
figure, panels = plt.subplots(
    1, 2, figsize=(9.5, 3.6), sharex=True, sharey=True, layout="constrained"
)
panels[0].set_title("400 actions at random")
panels[1].set_title("options at random, for 400 base steps")
torch.manual_seed(3)
five = [5]  # cars side by side
many = {"auto_reset": False, "break_when_any_done": False}
actions = base.rollout(400, tensordict=base.reset(TensorDict(batch_size=five)), **many)
options = shown.rollout(11, tensordict=shown.reset(TensorDict(batch_size=five)), **many)
for i in range(5):
    panels[0].plot(*actions["next", "car"][i].T, linewidth=1.2, alpha=0.8)
    ends = options["next", "done"][i].cumsum(0)  # an episode is over at its first 1
    within = options["next", "trajectory"][i][(ends - options["next", "done"][i].int())[:, 0] == 0]
    panels[1].plot(*within["car"][within["mask"]][:400].T, linewidth=1.2, alpha=0.8)
for axes in panels:
    axes.axvline(0.5, color="#16a34a", linestyle="--")
    axes.set_xlabel("position (dashed: the top)")
panels[0].set_ylabel("velocity")
plt.show()

# %%
# TorchRL's losses, correct over options
# --------------------------------------
#
# TorchRL's value estimators can discount by the time between observations. After every
# ``make_value_estimator``, tell the value estimator which key holds the duration. DQN:

from torch import nn
from torchrl.modules import QValueActor
from torchrl.objectives import A2CLoss, DQNLoss, SoftUpdate, ValueEstimators

GAMMA = 0.99


def network(out):  # position and velocity have very different scales
    class Scale(nn.Module):
        def forward(self, car):
            return (car + torch.tensor([0.4, 0.0])) * torch.tensor([2.0, 30.0])

    return nn.Sequential(
        Scale(), nn.Linear(2, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, out)
    )


net = network(2)
q = QValueActor(net, in_keys=["car"], action_space="categorical")
greedy = TensorDictModule(lambda car: net(car).argmax(-1), ["car"], ["option"])  # the best option
dqn = DQNLoss(q, action_space="categorical", delay_value=True)
dqn.set_keys(action="option")
dqn.make_value_estimator(gamma=GAMMA)
dqn.value_estimator.set_keys(steps_to_next_obs=("next", "duration"))  # gamma ** duration

# %%
# A2C, and with it any loss that estimates values, in the same way:

from torchrl.modules import ProbabilisticActor, ValueOperator

actor = ProbabilisticActor(
    TensorDictModule(network(2), ["car"], ["logits"]),
    in_keys=["logits"],
    out_keys=["option"],
    distribution_class=torch.distributions.Categorical,
    return_log_prob=True,
)
critic = ValueOperator(network(1), in_keys=["car"])
a2c = A2CLoss(actor, critic)
a2c.set_keys(action="option", sample_log_prob="option_log_prob")
a2c.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
a2c.value_estimator.set_keys(steps_to_next_obs=("next", "duration"))

# %%
# Is it what the equations say? The target of a step of :math:`k` base steps must be
# :math:`R + \gamma^k V(s')`, and nothing behind a terminal state:

batch = episodes.reshape(-1)[:500]
target = a2c.value_estimator(batch.clone())["value_target"]
ahead = critic(batch["next"].select("car"))["state_value"] * ~batch["next", "terminated"]
by_hand = batch["next", "reward"] + GAMMA ** batch["next", "duration"] * ahead
print(f"largest difference from the equation: {(target - by_hand).abs().max():.1e}")
one_by_one = batch["next", "reward"] + GAMMA * ahead
print(f"had every option counted as one step:  {(target - one_by_one).abs().max():.1e}")

# %%
# Learn
# -----
#
# The options drawn at random are data enough for DQN, as it learns from any behaviour.

data = episodes.reshape(-1).select(
    "car",
    "option",
    ("next", "car"),
    ("next", "reward"),
    ("next", "duration"),
    ("next", "done"),
    ("next", "terminated"),
)
print(f"{len(data):,} options, {int(data['next', 'terminated'].sum())} of which reached the top")
optimizer = torch.optim.Adam(dqn.parameters(), lr=1e-3)
updater = SoftUpdate(dqn, tau=0.02)
starts = env.reset(TensorDict(batch_size=[50]))


@torch.no_grad()
def base_steps_to_the_top():
    test = env.rollout(
        12,
        greedy,
        tensordict=starts.clone(),
        auto_reset=False,
        break_when_any_done=False,
        set_state=True,
    )
    over = test["next", "terminated"].cumsum(1) > 0
    steps = test["next", "duration"].cumsum(1)
    return (
        torch.where(over.any(1), steps[torch.arange(50), over.int().argmax(1).squeeze()], 600)
        .float()
        .mean()
        .item()
    )


curve = []
for update in range(801):
    if update % 100 == 0:
        curve.append((update, base_steps_to_the_top()))
    loss = dqn(data[torch.randint(len(data), (256,))])["loss"]
    loss.backward()
    optimizer.step()
    optimizer.zero_grad()
    updater.step()
print(f"base steps to the top, mean over 50 starts: {curve[-1][1]:.0f}")

# %%
# What it has learned: swing back, then drive out. The value of a state is :math:`\gamma` to the
# power of the base steps that are left, which is what makes it comparable between options of
# different lengths.

x, v = torch.meshgrid(
    torch.linspace(-1.2, 0.5, 120), torch.linspace(-0.07, 0.07, 80), indexing="xy"
)
with torch.no_grad():
    value = net(torch.stack((x, v), -1)).amax(-1)
start = env.reset().clone()
best = shown.rollout(8, greedy, tensordict=start, auto_reset=False, set_state=True)
track = best["next", "trajectory", "car"][best["next", "trajectory", "mask"]]

figure, (left, right) = plt.subplots(
    1, 2, figsize=(9.5, 3.6), layout="constrained", width_ratios=(1, 1.25)
)
left.plot(*zip(*curve, strict=True), color="#1d4ed8", linewidth=2)
left.set(xlabel="updates", ylabel="base steps", ylim=(0, None), title="base steps to the top")
left.grid(alpha=0.25)
mesh = right.pcolormesh(x, v, value, cmap="Blues", shading="auto", vmin=0, vmax=1)
right.plot(*track.T, color="#d51178", linewidth=2.5)
right.plot(*start["car"], "o", color="#1f2430")
right.set(xlabel="position", ylabel="velocity", title="value, and an episode")
figure.colorbar(mesh, ax=right)
plt.show()

# sphinx_gallery_thumbnail_number = 2
