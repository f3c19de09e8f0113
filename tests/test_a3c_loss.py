"""A3CLoss against Algorithm 2 written out, and TorchRL's own A2C.

Letters: B environments, T steps of a segment, S states, A actions.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import A2CLoss, ValueEstimators
from torchrl.objectives.value import TD1Estimator
from torchrl.trainers.algorithms.a2c import A2CTrainer

from torchrl_hmcts.objectives import A3CLoss, NStepReturn
from torchrl_hmcts.objectives.a3c import n_step_returns
from torchrl_hmcts.testing import ChainEnv

GAMMA, S, A = 0.9, 5, 3


class Table(nn.Module):
    """A row per state, as a network whose output is known; counts the states it is asked for."""

    def __init__(self, columns: int) -> None:
        super().__init__()
        self.entries = nn.Parameter(torch.randn(S, columns))
        self.asked = 0

    def forward(self, state: Tensor) -> Tensor:
        self.asked += state.numel()
        return self.entries[state]


def make_networks(actions: int = A) -> tuple[ProbabilisticActor, ValueOperator]:
    actor = ProbabilisticActor(
        TensorDictModule(Table(actions), ["state"], ["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
    )
    return actor, ValueOperator(Table(1), in_keys=["state"])


def make_segment(
    batch: tuple[int, ...] = (4,), steps: int = 12, duration: bool = True
) -> TensorDict:
    """A random segment in which a third of the steps end an episode, half of those truncated."""
    shape = (*batch, steps)
    done = torch.rand(*shape, 1) < 0.35
    after = {
        "state": torch.randint(S, shape),
        "reward": torch.randn(*shape, 1),
        "done": done,
        "terminated": done & (torch.rand(*shape, 1) < 0.5),
    }
    if duration:
        after["duration"] = torch.randint(1, 5, (*shape, 1))
    data = {"state": torch.randint(S, shape), "action": torch.randint(A, shape)}
    return TensorDict({**data, "next": TensorDict(after, shape)}, shape)


def algorithm_2(segment: TensorDict, values: list[float]) -> list[float]:
    """The returns of a segment [T], backwards, in plain Python."""
    after, steps = segment["next"], len(segment)
    returns, following = [0.0] * steps, 0.0
    for i in reversed(range(steps)):
        if after["terminated"][i]:
            following = 0.0
        elif after["done"][i] or i == steps - 1:
            following = values[int(after["state"][i])]
        k = int(after["duration"][i]) if "duration" in after.keys() else 1
        following = float(after["reward"][i]) + GAMMA**k * following
        returns[i] = following
    return returns


def test_returns_of_an_unbroken_segment_end_in_the_value_of_its_last_state() -> None:
    """8 -> 1 + 4 = 5 -> 1 + 2.5 = 3.5 -> 1 + 1.75 = 2.75, at a discount of a half."""
    one, no = torch.ones(3, 1), torch.zeros(3, 1, dtype=torch.bool)
    returns = n_step_returns(one, 0.5 * one, 8 * one, done=no, terminated=no)
    assert returns.flatten().tolist() == [2.75, 3.5, 5.0]


def test_nothing_follows_a_terminal_state_and_a_value_follows_a_truncated_one() -> None:
    """Steps: terminated, truncated, last; rewards 1, next values 8, discounts 1/2, 1/4, 1/2."""
    reward, value = torch.ones(3, 1), torch.full((3, 1), 8.0)
    discount = torch.tensor([[0.5], [0.25], [0.5]])
    done = torch.tensor([[True], [True], [False]])
    terminated = torch.tensor([[True], [False], [False]])
    returns = n_step_returns(reward, discount, value, done, terminated)
    assert returns.flatten().tolist() == [1.0, 3.0, 5.0]


@pytest.mark.parametrize("duration", [True, False])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_targets_are_those_of_algorithm_2_in_plain_python(
    batch: tuple[int, ...], duration: bool
) -> None:
    segment, (_, critic) = make_segment(batch, duration=duration), make_networks()
    values = critic.module.entries.detach().flatten().tolist()
    out = NStepReturn(gamma=GAMMA, value_network=critic)(segment.clone())
    expected = [algorithm_2(row, values) for row in segment.reshape(-1, segment.shape[-1])]
    expected = torch.tensor(expected).reshape(*segment.shape, 1)
    torch.testing.assert_close(out["value_target"], expected)
    torch.testing.assert_close(
        out["advantage"], expected - critic.module.entries.detach()[segment["state"]]
    )


@pytest.mark.parametrize("duration", [True, False])
def test_losses_are_those_of_plain_torch(duration: bool) -> None:
    segment, (actor, critic) = make_segment(duration=duration), make_networks()
    out = A3CLoss(actor, critic, gamma=GAMMA)(segment)
    values = critic.module.entries.detach().flatten()
    target = torch.tensor([algorithm_2(row, values.tolist()) for row in segment])
    advantage = target - values[segment["state"]]
    log_pi = actor.module[0].module.entries.detach()[segment["state"]].log_softmax(-1)
    chosen = log_pi.gather(-1, segment["action"].unsqueeze(-1)).squeeze(-1)
    entropy = -(log_pi.exp() * log_pi).sum(-1).mean()
    expected = {
        "loss_objective": -(chosen * advantage).mean(),
        "loss_critic": 0.5 * advantage.square().mean(),
        "loss_entropy": -0.01 * entropy,
        "entropy": entropy,
    }
    for key, value in expected.items():
        torch.testing.assert_close(out[key].detach().squeeze(), value, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("duration", [True, False])
def test_it_equals_a2c_with_torchrls_td1(duration: bool) -> None:
    segment, networks = make_segment(duration=duration), make_networks()
    theirs = A2CLoss(*networks, critic_coeff=0.5, loss_critic_type="l2")
    theirs.make_value_estimator(ValueEstimators.TD1, gamma=GAMMA)
    theirs.value_estimator.set_keys(steps_to_next_obs=("next", "duration"))
    expected, actual = theirs(segment.clone()), A3CLoss(*networks, gamma=GAMMA)(segment.clone())
    assert set(expected.keys()) == set(actual.keys())
    for key in expected.keys():
        torch.testing.assert_close(actual[key], expected[key], atol=1e-5, rtol=1e-4)


def test_the_critic_is_asked_for_next_values_only_where_they_are_used() -> None:
    segment, (_, critic) = make_segment((2,), 5), make_networks()
    segment["next", "done"].zero_()[0, 1] = True  # truncated; and two ends of the segment
    segment["next", "terminated"].zero_()
    NStepReturn(gamma=GAMMA, value_network=critic)(segment)
    assert critic.module.asked == 2 * 5 + 3


def test_a_value_that_is_not_finite_does_no_harm_where_it_is_not_used() -> None:
    """TorchRL writes nan into the next observation at an episode's end when it saves memory."""
    one, no = torch.ones(2, 1), torch.zeros(2, 1, dtype=torch.bool)
    ended = torch.tensor([[True], [False]])
    value = torch.tensor([[math.nan], [8.0]])
    returns = n_step_returns(one, 0.5 * one, value, ended, ended)
    assert returns.flatten().tolist() == [1.0, 5.0]
    assert no.sum() == 0


def test_an_advantage_that_is_there_already_is_used() -> None:
    segment, networks = make_segment(), make_networks()
    segment["advantage"] = torch.zeros(*segment.shape, 1)
    segment["value_target"] = networks[1].module.entries.detach()[segment["state"]] + 2.0
    out = A3CLoss(*networks)(segment)
    assert out["loss_objective"].item() == 0.0
    assert out["loss_critic"].item() == pytest.approx(0.5 * 4.0)


@pytest.mark.parametrize("option", ["average_rewards", "shifted"])
def test_what_else_td1_can_do_is_left_to_it(option: str) -> None:
    segment, (_, critic) = make_segment(), make_networks()
    segment["state"][:, 1:] = segment["next", "state"][:, :-1]
    settings: dict[str, Any] = {"gamma": GAMMA, "value_network": critic, option: True}
    expected = TD1Estimator(**settings)
    expected.set_keys(steps_to_next_obs=("next", "duration"))
    a, b = expected(segment.clone()), NStepReturn(**settings)(segment.clone())
    assert torch.equal(a["value_target"], b["value_target"])
    assert torch.equal(a["advantage"], b["advantage"])


def test_networks_can_keep_their_own_parameters() -> None:
    segment, networks = make_segment(), make_networks()
    expected = A3CLoss(*networks)(segment)
    loss = A3CLoss(*networks, functional=False)
    actual = loss(segment)
    assert all(torch.equal(actual[key], expected[key]) for key in expected.keys())
    assert {id(p) for p in loss.parameters()} == {
        id(p) for network in networks for p in network.parameters()
    }


@pytest.mark.filterwarnings("ignore:A2CTrainer is an experimental:UserWarning")
@pytest.mark.filterwarnings("ignore:The '.*' hook stage will be replaced:FutureWarning")
def test_it_solves_a_chain_in_torchrls_a2c_trainer() -> None:
    env = ChainEnv(length=S, batch_size=[16])
    actor, critic = make_networks(actions=2)
    loss = A3CLoss(actor, critic, gamma=GAMMA)
    collector = Collector(
        env,
        loss.actor_network,
        frames_per_batch=160,
        total_frames=160 * 40,
        auto_register_policy_transforms=False,
    )
    trainer = A2CTrainer(
        collector=collector,
        total_frames=160 * 40,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=0.1),
        gae=NStepReturn(gamma=GAMMA, value_network=critic),
        enable_logging=False,
        progress_bar=False,
    )
    trainer.train()
    logits = actor.module[0].module.entries.detach()
    assert (logits[: S - 1, 1] > logits[: S - 1, 0]).all()  # right, in every state
    value = critic.module.entries.detach().flatten()
    best = torch.tensor([GAMMA ** (S - 2 - s) for s in range(S - 1)])
    torch.testing.assert_close(value[: S - 1], best, atol=0.15, rtol=0.0)


def test_a_single_step_without_time_is_refused() -> None:
    with pytest.raises(ValueError, match="last dimension is time"):
        A3CLoss(*make_networks())(make_segment((), 1)[0])
