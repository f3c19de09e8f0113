"""
A manager by PPO over learned skills
====================================

The manager need not search. An :class:`~torchrl_hmcts.transforms.OptionTransform` makes every
option one step of a TorchRL env, so that any TorchRL agent can choose skills. Here PPO learns to
reach a target over four skills that DIAYN has learned before.
"""

# %%
# Skills
# ------
#
# They are learned without reward, in an empty room.

import torch
from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.trainers import DIAYNTrainer
from torchrl_hmcts.transforms import DisplacementTransform, OptionTransform, SkillTransform
from torchrl.envs import CatTensors, Compose, TransformedEnv

torch.manual_seed(0)
room = torch.zeros(1, 5, 5, dtype=torch.bool)  # no walls
env = TransformedEnv(
    WaterworldMazeEnv(room, batch_size=[32], observation=False),
    Compose(SkillTransform(4, max_skill_steps=50), DisplacementTransform()),
)
loss = DIAYNTrainer.make_loss(env, num_skills=4, seed=0)
DIAYNTrainer(env, loss, total_frames=12_800, seed=0).train()
worker = SkillPolicy(loss.actor_network, deterministic=True)

# %%
# The macro environment
# ---------------------
#
# An option lasts 10 base steps. The manager sees where the ball and its target are. The reward of
# an option is discounted inside it, :math:`R = \sum_{i<k} \gamma^i r_{i+1}`.

gamma = 0.99
macro = TransformedEnv(
    WaterworldMazeEnv(room, batch_size=[16], observation=False, max_steps=200),
    Compose(
        OptionTransform(worker, num_options=4, max_steps=10, gamma=gamma),
        CatTensors(["position", "target", "velocity"], "seen", del_keys=False),
    ),
)
print(macro.rollout(3)["next", "duration"].shape)

# %%
# PPO
# ---
#
# TorchRL's own modules and loss. One line is ours: ``use_durations`` lets the value estimator
# discount by the base steps of each option, :math:`\gamma^k` instead of :math:`\gamma`.

from tensordict.nn import TensorDictModule
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss, ValueEstimators
from torchrl_hmcts.objectives import use_durations

policy = ProbabilisticActor(
    TensorDictModule(MLP(6, 4, num_cells=[64, 64]), ["seen"], ["logits"]),
    in_keys=["logits"],
    out_keys=["option"],
    distribution_class=torch.distributions.Categorical,
    return_log_prob=True,
)
value = ValueOperator(MLP(6, 1, num_cells=[64, 64]), in_keys=["seen"])
ppo = ClipPPOLoss(policy, value, entropy_coeff=0.01)
ppo.set_keys(action="option")
ppo.make_value_estimator(ValueEstimators.GAE, gamma=gamma, lmbda=0.95)
use_durations(ppo, gamma=gamma)

# %%
# Forty batches of 16 x 40 options. The figure to watch is the base steps to the target.

optimizer = torch.optim.Adam(ppo.parameters(), lr=1e-3)
history = []
for _ in range(40):
    with torch.no_grad():
        batch = macro.rollout(40, policy, break_when_any_done=False)
    reached = batch["next", "terminated"].sum().item()
    history.append(batch["next", "duration"].sum().item() / max(reached, 1))
    for _ in range(4):
        with torch.no_grad():
            ppo.value_estimator(
                batch,
                params=ppo.critic_network_params,
                target_params=ppo.target_critic_network_params,
            )
        flat = batch.reshape(-1)
        for rows in torch.randperm(len(flat)).split(160):
            losses = ppo(flat[rows])
            total = sum(v for k, v in losses.items() if k.startswith("loss"))
            optimizer.zero_grad()
            total.backward()
            optimizer.step()
print("base steps to a target: first", round(history[0]), "last", round(history[-1]))

# %%
# Search reaches further without any training, where a simulator is at hand; the value that PPO has
# learned can guide it (:class:`~torchrl_hmcts.planners.ValueEvaluator`).

import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(6, 3.4), layout="constrained")
axes.plot(history, color="#1d4ed8")
axes.set(xlabel="batches of 640 options", ylabel="base steps to a target", ylim=(0, None))
axes.grid(alpha=0.25)
plt.show()
