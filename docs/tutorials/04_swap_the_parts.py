"""
Swap the parts
==============

Every part is an object that is passed in. This page exchanges the planner, the tree policy, the
leaf evaluator and the skill objective, and measures what each exchange does.
"""

# %%
# The task
# --------
#
# Mazes, and four options of 20 steps of thrust each (:doc:`02_plan_over_options`).

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.transforms import OptionTransform

worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])


def make_env():
    options = OptionTransform(worker, num_options=4, max_steps=20, gamma=0.99)
    return TransformedEnv(WaterworldMazeEnv(observation=False, seed=0), options)


env = make_env()
starts = env.reset(TensorDict(batch_size=[8]))

# %%
# The planner
# -----------
#
# A planner is a policy: a module that reads a state and writes the option. All that does so takes
# the place of tree search. Here is one that tries sequences of options at random and takes the
# best, in a dozen lines, with the macro env as its simulator:

from tensordict.nn import TensorDictModuleBase


class RandomShooting(TensorDictModuleBase):
    def __init__(self, env, sequences=16, length=6):
        super().__init__()
        self.env, self.sequences, self.length = env, sequences, length
        self.in_keys, self.out_keys = list(env.state_keys), ["option"]

    def forward(self, td):
        state = td.select(*self.env.state_keys).expand(self.sequences, *td.shape).clone()
        plans = torch.randint(4, (self.length, self.sequences, *td.shape))
        nearest = torch.full(plans.shape[1:], torch.inf)  # how near each sequence gets
        for options in plans:
            state = self.env._step(state.set("option", options)).select(*self.env.state_keys)
            distance = (state["position"] - state["target"]).norm(dim=-1)
            nearest = torch.minimum(nearest, distance)
        best = nearest.argmin(0, keepdim=True)
        return td.set("option", plans[0].gather(0, best)[0])


planners = {
    "tree search": MCTSPlanner(make_env(), novelty=RadiusNovelty("position", 0.6), seed=0),
    "random shooting": RandomShooting(make_env()),
    "no planning": None,
}
torch.manual_seed(0)
for name, planner in planners.items():
    episodes = env.rollout(
        12,
        policy=planner,
        tensordict=starts.clone(),
        auto_reset=False,
        set_state=True,
        break_when_any_done=False,
        break_when_all_done=True,
    )
    solved = episodes["next", "terminated"].any(1).sum()
    print(f"{name:<16} solves {int(solved):>2} of 8 mazes within 12 options")

# %%
# The leaf evaluator
# ------------------
#
# What a state is worth before anything below it is known: nothing, a function, a network
# (``ValueEvaluator``), or a rollout. Here: the nearer to the target, as the crow flies, the
# better.


def nearness(td):
    return 0.99 ** (10 * (td["position"] - td["target"]).norm(dim=-1))


# %%
# The tree policy
# ---------------
#
# ``UCT``, ``PUCT``, the scores of ``torchrl.modules.mcts``, or any function of
# :class:`~torchrl_hmcts.planners.NodeStatistics`, such as the one below. (``Gumbel`` is for budgets
# of few simulations with a learned network.)

from torchrl.modules.mcts import PUCTScore
from torchrl_hmcts.planners import PUCT, UCT, TorchRLScore


def least_visited(node):
    return node.option_values - 0.3 * node.option_visits / node.node_visits.unsqueeze(-1)


def cost(**parts):
    planner = MCTSPlanner(
        make_env(),
        novelty=RadiusNovelty("position", 0.6),
        budget=SearchBudget(expansions=60),
        seed=0,
        **parts,
    )
    planner.plan(starts)
    return sorted(planner.last_search.num_base_steps.tolist())


costs = {
    "UCT(c=1), leaves worth nothing": cost(),
    "UCT(c=1)": cost(leaf_evaluator=nearness),
    "UCT(c=0.1)": cost(leaf_evaluator=nearness, tree_policy=UCT(c=0.1)),
    "PUCT(c=0.3)": cost(leaf_evaluator=nearness, tree_policy=PUCT(c=0.3)),
    "TorchRL's PUCTScore(c=0.3)": cost(
        leaf_evaluator=nearness, tree_policy=TorchRLScore(PUCTScore(c=0.3))
    ),
    "our own function": cost(leaf_evaluator=nearness, tree_policy=least_visited),
}

import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(8.5, 3.6), layout="constrained")
axes.boxplot(
    list(costs.values()),
    tick_labels=list(costs),
    orientation="horizontal",
    whis=(5, 95),
    showfliers=False,
    medianprops={"color": "#e66100", "linewidth": 2},
)
axes.invert_yaxis()
axes.set(title="simulated base steps per search, 8 mazes", xlim=(0, None))
axes.grid(alpha=0.25, axis="x")
plt.show()

# %%
# The skill objective
# -------------------
#
# For learned workers, what makes skills different is an object too. DIAYN's discriminator
# (:doc:`03_skills_in_sac_trainer`), or METRA's encoder, whose skills go far; the trainer does not
# know which.

from torchrl_hmcts.modules import SkillEncoder, SkillPolicy
from torchrl_hmcts.objectives import METRAEncoderLoss
from torchrl_hmcts.planners import option_color
from torchrl_hmcts.trainers import DIAYNTrainer, make_training_env
from torchrl_hmcts.transforms import SkillReward

training_env = make_training_env(num_skills=4)
objective = METRAEncoderLoss(SkillEncoder(2, num_skills=4, in_keys=["position"]))
loss = DIAYNTrainer.make_loss(training_env, objective=objective, seed=0)
reward = SkillReward(objective, intrinsic_coeff=3.0)
DIAYNTrainer(training_env, loss, total_frames=6_400, reward=reward, seed=0).train()

# %%
# Ten mini-episodes of every skill from the middle of an open room:

room = WaterworldMazeEnv(torch.zeros(1, 9, 9, dtype=torch.bool), observation=False)
skills = torch.arange(4).repeat_interleave(10)
td = room.make_state(torch.zeros_like(skills), (4.5, 4.5), (0.5, 8.5))
points, policy = [td["position"]], SkillPolicy(loss.actor_network)
for _ in range(60):
    td = room.step(policy(td.set("skill", skills)))["next"].exclude("reward")
    points.append(td["position"])

figure, axes = plt.subplots(figsize=(4, 4), layout="constrained")
for skill, track in zip(skills.tolist(), torch.stack(points, 1), strict=True):
    axes.plot(*track.T, color=option_color(skill), linewidth=1.3, alpha=0.7)
axes.set(xlim=(0, 9), ylim=(9, 0), xticks=[], yticks=[], aspect="equal")
axes.spines[:].set(visible=True, linewidth=2.5)
plt.show()

# %%
# After 6,400 base steps, a sixth of a full training, skills may still overlap. :doc:`/skills`
# compares four objectives over three seeds.

# sphinx_gallery_thumbnail_number = 1
