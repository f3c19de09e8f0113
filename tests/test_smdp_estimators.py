"""TorchRL's estimators and losses on a macro env: each macro-step is discounted by its duration.

Letters: B batch, T macro-steps of a rollout; k the duration of a macro-step in base steps.
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import TransformedEnv
from torchrl.modules import ProbabilisticActor, QValueActor, ValueOperator
from torchrl.objectives import (
    A2CLoss,
    ClipPPOLoss,
    DiscreteSACLoss,
    DQNLoss,
    ValueEstimators,
)
from torchrl.objectives.value import GAE, TD0Estimator
from torchrl.trainers.algorithms.ppo import PPOTrainer

from torchrl_hmcts.objectives import use_durations as durations
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.transforms import OptionTransform

GAMMA, LMBDA = 0.9, 0.8
STATES, OPTIONS = 7, 2


def macro_env():
    """Options of one to three base steps: they end in states 1 and 4 too."""
    worker = TensorDictModule(lambda skill: skill.clone(), ["skill"], ["action"])
    ends_at = torch.tensor([False, True, False, False, True, False, False])
    env = ChainEnv(STATES, reward_per_step=-0.1)
    return TransformedEnv(
        env, OptionTransform(worker, OPTIONS, 3, GAMMA, lambda td: ends_at[td["state"]])
    )


@pytest.fixture
def rollout():
    """Macro-steps [B=4, T=25] with durations 1 to 3 and with ends of episodes among them."""
    env = macro_env()

    def policy(td):
        return td.set("option", (torch.rand(td.shape) < 0.7).long())

    td = env.reset(TensorDict(batch_size=[4]))
    td = env.rollout(25, policy, tensordict=td, auto_reset=False, break_when_any_done=False)
    assert set(td["next", "duration"].unique().tolist()) == {1, 2, 3}
    assert td["next", "terminated"].any()
    return td


class Table(nn.Module):
    """A value per state (and option), as a network whose output is known."""

    def __init__(self, *columns):
        super().__init__()
        self.entries = nn.Parameter(torch.randn(STATES, *columns))

    def forward(self, state):
        return self.entries[state]


@pytest.fixture
def critic():
    return ValueOperator(Table(1), in_keys=["state"])


def smdp_targets(td, next_value):
    """R + gamma**k V(s'), [B, T, 1]; V of a terminal state is 0."""
    discount = GAMMA ** td["next", "duration"]
    return td["next", "reward"] + discount * next_value * ~td["next", "terminated"]


def values(td, critic):
    table = critic.module.entries.detach()
    return table[td["state"]], table[td["next", "state"]]


def advantages_by_loop(td, value, next_value, lmbda):
    """GAE of an SMDP, backwards over the macro-steps."""
    delta = smdp_targets(td, next_value) - value
    advantage, out = torch.zeros_like(value[:, 0]), []
    for t in reversed(range(td.shape[1])):
        goes_on = ~td["next", "done"][:, t]
        carry = lmbda * GAMMA ** td["next", "duration"][:, t] * goes_on
        advantage = delta[:, t] + carry * advantage
        out.insert(0, advantage)
    return torch.stack(out, 1)


class TestEstimators:
    @pytest.mark.parametrize("kind", ["TD(0)", "GAE", "GAE, vectorized"])
    def test_advantages_are_discounted_by_the_duration(self, rollout, critic, kind):
        settings = {"gamma": GAMMA, "value_network": critic}
        if kind == "TD(0)":  # which is GAE with a lambda of 0
            estimator, lmbda = TD0Estimator(**settings), 0.0
        else:
            estimator, lmbda = GAE(lmbda=LMBDA, vectorized="," in kind, **settings), LMBDA
        value, next_value = values(rollout, critic)
        expected = advantages_by_loop(rollout, value, next_value, lmbda)
        out = durations(estimator)(rollout.clone())
        torch.testing.assert_close(out["advantage"], expected, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(out["value_target"], expected + value, atol=1e-5, rtol=1e-4)


class TestAChainOfKnownValue:
    """The values of going to the right are known; where durations count, they are a fixed point.

    From state s the end of five states is 4 - s base steps away and worth 1: V(s) = 0.9^(3 - s).
    Two options of two base steps lead from 0 to 2 and from 2 to the end.
    """

    VALUES = torch.tensor([[GAMMA**3], [GAMMA**2], [GAMMA], [1.0], [0.0]])

    @pytest.fixture
    def known(self):
        worker = TensorDictModule(lambda skill: skill.clone(), ["skill"], ["action"])
        options = OptionTransform(worker, OPTIONS, 2, GAMMA, option_key="action")
        env = TransformedEnv(ChainEnv(5), options)
        data = env.rollout(5, lambda td: td.set("action", torch.tensor(1)))
        assert data["next", "duration"].flatten().tolist() == [2, 2]
        data.set("action_log_prob", torch.zeros(2))
        return data

    def table(self, *columns):
        table = Table(*columns)
        table.entries.data = (
            self.VALUES
            if columns == (1,)
            else torch.cat((torch.full_like(self.VALUES, -9.0), self.VALUES), -1)
        )
        return table

    def actor(self):
        logits = Table(OPTIONS)
        logits.entries.data = torch.tensor([[-30.0, 30.0]]).repeat(5, 1)
        return ProbabilisticActor(
            TensorDictModule(logits, ["state"], ["logits"]),
            in_keys=["logits"],
            distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
        )

    def errors(self, name, data, told):
        """What is left of the errors of the known values, with durations told or not."""

        def make(loss):
            if told:
                return durations(loss, gamma=GAMMA)
            loss.make_value_estimator(gamma=GAMMA)
            return loss

        critic = ValueOperator(self.table(1), in_keys=["state"])
        if name == "DQN":
            q = QValueActor(self.table(OPTIONS), in_keys=["state"], action_space="categorical")
            loss = make(DQNLoss(q, action_space="categorical", delay_value=False))
            return loss(data)["loss"]
        if name == "A2C":
            return make(A2CLoss(self.actor(), critic))(data)["loss_critic"]
        if name == "PPO":
            return make(ClipPPOLoss(self.actor(), critic))(data)["loss_critic"]
        if name == "PPO's GAE":
            gae = GAE(gamma=GAMMA, lmbda=LMBDA, value_network=critic)
            return (durations(gae) if told else gae)(data)["advantage"].abs().sum()
        q = TensorDictModule(self.table(OPTIONS), ["state"], ["action_value"])
        loss = DiscreteSACLoss(
            self.actor(),
            q,
            action_space="categorical",
            num_actions=OPTIONS,
            alpha_init=1e-9,
            fixed_alpha=True,
            loss_function="l2",
            target_entropy=0.0,
            delay_qvalue=False,
        )
        for entry in loss.qvalue_network_params.values(True, True):
            entry.data.copy_(self.table(OPTIONS).entries.expand_as(entry))
        return make(loss)(data)["loss_qvalue"]

    @pytest.mark.parametrize("name", ["DQN", "A2C", "PPO", "PPO's GAE", "discrete SAC"])
    def test_only_with_durations_the_known_values_are_right(self, known, name):
        assert self.errors(name, known.clone(), told=True).item() == pytest.approx(0, abs=1e-6)
        assert self.errors(name, known.clone(), told=False).item() > 1e-3

    @pytest.mark.filterwarnings("ignore:PPOTrainer is an experimental:UserWarning")
    def test_a_ppo_trainer_discounts_by_durations_where_it_is_given_the_gae(self, known):
        critic = ValueOperator(self.table(1), in_keys=["state"])
        for gae, right in (
            (None, False),
            (durations(GAE(gamma=GAMMA, lmbda=LMBDA, value_network=critic)), True),
        ):
            loss = ClipPPOLoss(self.actor(), critic)
            trainer = PPOTrainer(
                collector=[],
                total_frames=1,
                frame_skip=1,
                optim_steps_per_batch=1,
                loss_module=durations(loss, gamma=GAMMA),
                gamma=GAMMA,
                lmbda=LMBDA,
                gae=gae,
                progress_bar=False,
            )
            advantage = trainer._pre_epoch_hook(known.clone())["advantage"]
            assert (advantage.abs().max() < 1e-6) == right

    def test_a_new_estimator_has_to_be_told_again(self, known):
        q = QValueActor(self.table(OPTIONS), in_keys=["state"], action_space="categorical")
        loss = DQNLoss(q, action_space="categorical", delay_value=False)
        assert durations(loss, gamma=GAMMA)(known.clone())["loss"] < 1e-6
        loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
        assert loss(known)["loss"] > 1e-3

    def test_what_does_not_discount_is_refused(self):
        with pytest.raises(TypeError, match="ValueEstimatorBase for module; got Linear"):
            durations(nn.Linear(1, 1))
        critic = ValueOperator(self.table(1), in_keys=["state"])
        gae = GAE(gamma=GAMMA, lmbda=LMBDA, value_network=critic)
        with pytest.raises(ValueError, match="gamma=0.9 for a GAE, which has its own"):
            durations(gae, gamma=0.9)
        with pytest.raises(ValueError, match="gamma.*got 1.5"):
            durations(ClipPPOLoss(self.actor(), critic), gamma=1.5)
