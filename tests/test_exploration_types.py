"""TorchRL's ``set_exploration_type`` and what acts or ends at random."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_hmcts.modules import (
    LearnedTermination,
    SkillActor,
    SkillPolicy,
    TerminationNetwork,
)

SPECS = [Categorical(4), OneHot(4), Bounded(-2.0, 1.0, shape=(2,))]
NOT_RANDOM = [ExplorationType.MODE, ExplorationType.MEAN, ExplorationType.DETERMINISTIC]


def states(n: int = 200) -> TensorDict:
    skill = torch.arange(n) % 3
    return TensorDict(velocity=torch.zeros(n, 2), skill=skill, batch_size=[n])


def actor(spec: TensorSpec) -> SkillActor:
    return SkillActor(2, spec, num_skills=3, in_keys=["velocity"])


def kinds(action: torch.Tensor) -> int:
    """How many different actions are taken in one state with one skill."""
    return len(action[::3].reshape(len(action[::3]), -1).unique(dim=0))


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: type(spec).__name__)
class TestSkillPolicy:
    @pytest.mark.parametrize("kind", NOT_RANDOM)
    def test_it_takes_the_best_action_where_it_is_asked_to(
        self, spec: TensorSpec, kind: ExplorationType
    ) -> None:
        network = actor(spec)
        with set_exploration_type(kind):
            action = SkillPolicy(network)(states())["action"]
        best = SkillPolicy(network, deterministic=True)(states())["action"]
        torch.testing.assert_close(action, best)

    def test_it_samples_where_it_is_asked_to_or_nobody_says(self, spec: TensorSpec) -> None:
        policy = SkillPolicy(actor(spec))
        assert kinds(policy(states())["action"]) > 1
        with set_exploration_type(ExplorationType.RANDOM):
            assert kinds(policy(states())["action"]) > 1

    def test_a_deterministic_one_never_samples(self, spec: TensorSpec) -> None:
        policy = SkillPolicy(actor(spec), deterministic=True)
        with set_exploration_type(ExplorationType.RANDOM):
            assert kinds(policy(states())["action"]) == 1


@pytest.mark.parametrize("spec", SPECS[:2], ids=lambda spec: type(spec).__name__)
@pytest.mark.parametrize("kind", NOT_RANDOM)
def test_a_discrete_actor_has_a_best_action_of_each_kind(
    spec: TensorSpec, kind: ExplorationType
) -> None:
    network = actor(spec)
    best = SkillPolicy(network, deterministic=True)(states())["action"]
    with set_exploration_type(kind):
        torch.testing.assert_close(network(states())["action"], best, check_dtype=False)


@pytest.mark.parametrize("kind", NOT_RANDOM)
def test_a_termination_that_samples_does_not_where_it_is_asked_not_to(
    kind: ExplorationType,
) -> None:
    network = TerminationNetwork(2, num_options=3, in_keys=["velocity"], initial_probability=0.6)
    termination = LearnedTermination(network, deterministic=False)
    td = states().set("duration", torch.ones(200, 1, dtype=torch.int64))
    assert len(termination(td).unique()) == 2
    with set_exploration_type(kind):
        assert (termination(td) == (termination.probability(td) >= 0.5)).all()
    with set_exploration_type(ExplorationType.RANDOM):
        assert len(termination(td).unique()) == 2
