"""Distributions over skills: fixed, growing, learned; their loss, and the mask for planners."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.modules import (
    FixedSkillPrior,
    GrowingSkillPrior,
    LearnedSkillPrior,
    SkillPrior,
)
from torchrl_hmcts.modules.skill_prior import as_skill_prior
from torchrl_hmcts.objectives import SkillPriorLoss
from torchrl_hmcts.planners import MCTSPlanner
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.transforms import OptionTransform, SkillMaskTransform


def test_a_growing_prior_is_uniform_over_the_first_skills_and_resumes_so() -> None:
    prior = GrowingSkillPrior(5)
    assert prior.probs().tolist() == [0.5, 0.5, 0.0, 0.0, 0.0]
    prior.set_num_active(4)
    assert prior.probs().tolist() == [0.25, 0.25, 0.25, 0.25, 0.0]
    assert prior.log_probs()[-1] == -math.inf
    again = GrowingSkillPrior(5)
    again.load_state_dict(prior.state_dict())
    assert int(again.num_active) == 4
    assert list(prior.parameters()) == []


def test_a_dropped_skill_is_off_until_it_is_taken_back() -> None:
    prior = GrowingSkillPrior(4, 3)
    prior.drop(1)
    assert prior.probs().tolist() == [0.5, 0.0, 0.5, 0.0]
    again = GrowingSkillPrior(4)
    again.load_state_dict(prior.state_dict())
    assert again.probs().tolist() == [0.5, 0.0, 0.5, 0.0]
    prior.drop(1, dropped=False)
    assert prior.active().tolist() == [True, True, True, False]
    prior.drop(0)
    prior.drop(1)
    with pytest.raises(ValueError, match="2 is the last one"):
        prior.drop(2)
    assert prior.active().tolist() == [False, False, True, False]


def test_a_prior_argument_may_be_nothing_numbers_or_a_prior() -> None:
    assert as_skill_prior("X", None, 4).probs().tolist() == [0.25] * 4
    assert as_skill_prior("X", torch.tensor([3.0, 1.0]), 2).probs().tolist() == [0.75, 0.25]
    prior = GrowingSkillPrior(2)
    assert as_skill_prior("X", prior, 2) is prior
    with pytest.raises(ValueError, match="X has 3 skills, but its prior is over 2"):
        as_skill_prior("X", prior, 3)


# ---------------------------------------------------------------- the loss


def transitions(skill: list[int], reward: list[float]) -> TensorDict:
    after = TensorDict(reward=torch.tensor(reward).unsqueeze(-1), batch_size=[len(skill)])
    return TensorDict(skill=torch.tensor(skill), next=after, batch_size=[len(skill)])


def minimise(loss: SkillPriorLoss, data: Any, steps: int = 120, lr: float = 0.3) -> Tensor:
    optimizer = torch.optim.Adam(loss.parameters(), lr=lr)
    for _ in range(steps):
        optimizer.zero_grad()
        loss(data() if callable(data) else data)["loss_skill_prior"].backward()
        optimizer.step()
    return loss.prior.probs().detach()


def test_the_loss_has_its_closed_form() -> None:
    # p = (3/4, 1/4); mean rewards 2 and -1 without a prior in them.
    prior = LearnedSkillPrior(2, [math.log(3.0), 0.0])
    td = transitions([0, 0, 1], [1.0, 3.0, -1.0])
    out = SkillPriorLoss(prior, entropy_coeff=0.5, prior_in_reward=False)(td)
    entropy = -(0.75 * math.log(0.75) + 0.25 * math.log(0.25))
    expected = -(0.75 * 2.0 + 0.25 * -1.0) - 0.5 * entropy
    assert out["loss_skill_prior"].item() == pytest.approx(expected)
    assert out["skill_prior_entropy"].item() == pytest.approx(entropy)
    assert out["num_effective_skills"].item() == pytest.approx(math.exp(entropy))
    assert out["loss_skill_prior"].requires_grad
    assert not out["skill_prior_entropy"].requires_grad
    # With -log p(z) in the reward, log p(z) is added back before the mean is taken.
    with_prior = SkillPriorLoss(prior, entropy_coeff=0.5)
    with_prior(td)
    torch.testing.assert_close(
        with_prior.mean_reward, torch.tensor([2.0 + math.log(0.75), -1.0 + math.log(0.25)])
    )


def test_the_gradient_is_the_mean_of_the_score_function_gradient() -> None:
    # E_z[grad log p(z) (r(z) - b)] with r(z) = log q(z) - log p(z) is that of variational
    # intrinsic control; here the expectation is written out, for q(z) = (0.2, 0.5, 0.3).
    log_q = torch.tensor([0.2, 0.5, 0.3]).log()
    prior = LearnedSkillPrior(3, [0.5, 0.0, -0.5])
    reward = (log_q - prior.log_probs()).detach()
    score = (prior.probs().detach() * prior.log_probs() * (reward - 0.3)).sum()
    (expected,) = torch.autograd.grad(score, prior.logits)
    SkillPriorLoss(prior)(transitions([0, 1, 2], reward.tolist()))["loss_skill_prior"].backward()
    torch.testing.assert_close(-prior.logits.grad, expected)


@pytest.mark.parametrize("beta", [0.5, 1.0, 4.0])
def test_the_minimum_is_the_softmax_of_the_rewards(beta: float) -> None:
    prior = LearnedSkillPrior(3)
    rewards = torch.tensor([0.0, -0.5, -1.5])

    def data() -> TensorDict:  # as from DIAYN's reward, which moves with p(z)
        seen = rewards - prior.log_probs().detach()
        return transitions([0, 1, 2], seen.tolist())

    probs = minimise(SkillPriorLoss(prior, entropy_coeff=beta), data)
    torch.testing.assert_close(probs, (rewards / beta).softmax(-1), atol=1e-3, rtol=0)


def test_the_mean_runs_over_batches_and_a_skill_never_seen_counts_as_average() -> None:
    loss = SkillPriorLoss(LearnedSkillPrior(3), decay=0.75, prior_in_reward=False)
    loss(transitions([0, 1, 1], [1.0, 2.0, 4.0]))
    torch.testing.assert_close(loss.skill_rewards(), torch.tensor([1.0, 3.0, 2.0]))
    loss(transitions([0], [5.0]))
    torch.testing.assert_close(loss.skill_rewards(), torch.tensor([2.0, 3.0, 2.5]))
    loss.eval()
    loss(transitions([0], [100.0]))
    assert loss.skill_rewards()[0] == 2.0
    again = SkillPriorLoss(LearnedSkillPrior(3))
    again.load_state_dict(loss.state_dict())
    assert torch.equal(again.skill_rewards(), loss.skill_rewards())


def test_transitions_of_a_skill_that_is_off_do_not_count() -> None:
    class OnlyFirst(LearnedSkillPrior):
        def probs(self) -> Tensor:
            return self.logits.masked_fill(torch.tensor([False, True]), -math.inf).softmax(-1)

        def log_probs(self) -> Tensor:
            return self.probs().log()

    out = SkillPriorLoss(OnlyFirst(2))(transitions([0, 1], [0.5, 7.0]))
    assert out["loss_skill_prior"].item() == pytest.approx(-0.5)


# ---------------------------------------------------------------- the mask


def masked_chain(prior: SkillPrior, **kwargs: Any) -> TransformedEnv:
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    options = OptionTransform(worker, prior.num_skills, 2)
    return TransformedEnv(ChainEnv(length=6), Compose(options, SkillMaskTransform(prior, **kwargs)))


def test_the_mask_follows_the_prior_at_reset_and_at_every_step() -> None:
    prior = GrowingSkillPrior(2, 1)
    env = masked_chain(prior)
    check_env_specs(env)
    td = env.reset(TensorDict(batch_size=[3]))
    assert td["action_mask"].tolist() == [[True, False]] * 3
    prior.set_num_active(2)
    td = env.step(td.set("option", torch.zeros(3, dtype=torch.int64)))
    assert td["action_mask"].tolist() == [[True, False]] * 3
    assert td["next", "action_mask"].tolist() == [[True, True]] * 3


def test_the_planner_takes_no_option_whose_skill_is_off() -> None:
    prior = FixedSkillPrior(2, [1.0, 0.0])  # only to the left; the reward is at the right end
    env = masked_chain(prior)
    planner = MCTSPlanner(env, seed=0)
    plan = planner.plan(env.reset().unsqueeze(0))
    assert not plan.found.any()
    assert planner.last_search is not None
    visits = planner.last_search.tree.edges["visits"][0, 0]
    assert visits[0] > 0 == visits[1]
    everything = masked_chain(FixedSkillPrior(2))
    assert MCTSPlanner(everything, seed=0).plan(everything.reset().unsqueeze(0)).found.all()


def test_a_mask_that_makes_no_sense_is_refused() -> None:
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    mask = SkillMaskTransform(GrowingSkillPrior(3))
    env = TransformedEnv(ChainEnv(length=6), Compose(OptionTransform(worker, 2, 2), mask))
    with pytest.raises(ValueError, match="of 3 skills.*'option' has 2"):
        _ = env.observation_spec
