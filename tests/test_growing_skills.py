"""GrowSkills and SearchCoverage."""

from __future__ import annotations

import itertools
import math
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from small_trainers import differences
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, TransformedEnv

from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.modules import FixedSkillPrior, GrowingSkillPrior
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.skills.growing import GrowSkills, SearchCoverage
from torchrl_hmcts.transforms import (
    DisplacementTransform,
    OptionTransform,
    SkillMaskTransform,
    SkillTransform,
)


class FakeTrainer:
    """The part of a Trainer that GrowSkills uses; a batch is 100 base steps."""

    def __init__(self) -> None:
        self.collected_frames = 0
        self.modules: dict[str, Any] = {}
        self.loss_module = torch.nn.Linear(1, 1, bias=False)
        self.optimizer = torch.optim.SGD(self.loss_module.parameters(), lr=0.1)
        self.replay_buffer = ReplayBuffer(storage=LazyTensorStorage(1000))

    def register_op(self, stage: str, op: Any) -> None:
        assert stage in ("post_optim_complete_log", "post_steps")

    def register_module(self, name: str, module: Any) -> None:
        self.modules[name] = module


def run(
    grow: GrowSkills,
    accuracies: Iterator[float],
    batches: int,
    trainer: FakeTrainer | None = None,
) -> list[int]:
    """Trains for some batches; returns the number of skills after each."""
    if trainer is None:
        trainer = FakeTrainer()
    if grow._trainer is None:
        grow.register(trainer)  # type: ignore[arg-type]
    numbers = []
    for _ in range(batches):
        trainer.collected_frames += 100
        trainer.replay_buffer.extend(torch.zeros(100))
        trainer.loss_module.weight.data.fill_(trainer.collected_frames)
        grow.watch(1, TensorDict(discriminator_accuracy=next(accuracies)))
        grow()
        numbers.append(int(grow.prior.num_active))
    return numbers


def make(coverages: list[float], room: int = 6, **kwargs: Any) -> GrowSkills:
    values = iter(coverages)
    options = {"min_base_steps": 200, "max_base_steps": 400, "window": 2, "prune": False}
    options.update(kwargs)
    return GrowSkills(GrowingSkillPrior(room, 2), lambda: next(values), **options)


def flat() -> Iterator[float]:
    return itertools.repeat(0.9)


@pytest.mark.parametrize(
    ("coverages", "patience", "numbers", "better", "gains"),
    [  # judged every 200 base steps, two batches, since the accuracy does not rise
        (
            [10.0, 15.0, 20.0, 20.5],  # the skill that adds nothing goes
            1,
            [2, 3, 3, 4, 4, 5, 5, 4, 4, 4, 4, 4],
            [True, True, True, False],
            [0.5, 1 / 3, 0.025],
        ),
        (
            [10.0, 9.0, 20.0, 19.0, 20.0],  # skills that add nothing get a second chance
            2,
            [2, 3, 3, 4, 4, 5, 5, 6, 6, 4, 4, 4],
            [True, False, True, False, False],
            [-0.1, 1.0, -0.05, 0.0],
        ),
        (
            [10.0, 9.0, 9.0, 20.0, 19.0],  # it does not end before one skill has added something
            1,
            [2, 3, 3, 4, 4, 5, 5, 6, 6, 5, 5],
            [True, False, False, True, False],
            [-0.1, -0.1, 1.0, -0.05],
        ),
    ],
)
def test_skills_are_added_while_they_add_coverage(
    coverages: list[float],
    patience: int,
    numbers: list[int],
    better: list[bool],
    gains: list[float],
) -> None:
    grow = make(coverages, patience=patience)
    assert run(grow, flat(), len(numbers)) == numbers
    assert grow.finished
    assert grow.history["num_active"] == list(range(2, 2 + len(better)))
    assert grow.history["better"] == better
    assert grow.history["base_steps"] == [200 * (i + 1) for i in range(len(better))]
    assert math.isnan(grow.history["gain"][0])
    assert grow.history["gain"][1:] == pytest.approx(gains)


def test_the_best_skills_get_their_weights_back_and_data_of_other_numbers_are_forgotten() -> None:
    trainer = FakeTrainer()
    grow = make([10.0, 15.0, 20.0, 20.5], patience=1)
    sizes = []
    for _ in range(10):
        run(grow, flat(), 1, trainer)
        sizes.append((int(trainer.loss_module.weight), len(trainer.replay_buffer)))
    # At 800 base steps five skills had added too little to the four of 600.
    expected = [100, 200, 300, 400, 500, 600, 700, 600, 900, 1000]
    assert [weight for weight, _ in sizes] == expected
    assert [stored for _, stored in sizes] == [100, 0, 100, 0, 100, 0, 100, 0, 100, 200]


def test_skills_that_are_still_being_learned_are_judged_only_at_the_latest() -> None:
    grow = make([10.0, 15.0, 15.0])
    assert run(grow, (0.1 * i for i in itertools.count()), 8) == [2, 2, 2, 3, 3, 3, 3, 4]


def test_growing_ends_when_there_is_no_room() -> None:
    grow = make([1.0, 2.0, 3.0], room=3)
    assert run(grow, flat(), 8)[-1] == 3
    assert grow.finished


def test_pruning_drops_the_skills_without_which_coverage_is_no_smaller() -> None:
    # Directions of the skills; two that do the same cost without covering more.
    direction = ["north", "south", "south", "east", "east", "west"]
    prior = GrowingSkillPrior(6, 2)

    def coverage() -> float:
        on = prior.active().nonzero().flatten().tolist()
        return 10.0 * len({direction[skill] for skill in on}) - len(on)

    options: dict[str, Any] = {"min_base_steps": 100, "max_base_steps": 100}
    grow = GrowSkills(prior, coverage, patience=2, **options)
    assert run(grow, flat(), 6) == [3, 4, 5, 6, 6, 6]
    assert grow.history["better"] == [True, False, True, False, True]
    assert grow.dropped == [1, 3]
    assert prior.active().tolist() == [True, False, True, False, True, True]
    assert grow.watch(1, None) == {"num_active_skills": 4.0}
    again = GrowSkills(GrowingSkillPrior(6, 2), coverage, **options)
    again.load_state_dict(grow.state_dict())
    assert again.dropped == [1, 3]
    assert torch.equal(again.prior.active(), prior.active())


def test_no_coverage_at_all_does_not_stop_it() -> None:
    grow = make([0.0, 0.0, 3.0], room=4)
    assert run(grow, flat(), 6) == [2, 3, 3, 4, 4, 4]
    assert grow.history["gain"][1:] == [math.inf, math.inf]


def test_its_state_resumes_with_the_prior_and_the_best_weights() -> None:
    whole_trainer, part_trainer = FakeTrainer(), FakeTrainer()
    whole = make([10.0, 15.0, 20.0, 20.5], patience=1)
    run(whole, flat(), 8, whole_trainer)
    first = make([10.0, 15.0, 20.0], patience=1)
    run(first, flat(), 7, part_trainer)
    second = make([20.5], patience=1)
    state = pickle.loads(pickle.dumps(first.state_dict()))
    second.load_state_dict(state)
    assert int(second.prior.num_active) == 5
    run(second, flat(), 1, part_trainer)
    assert int(second.prior.num_active) == 4
    assert part_trainer.loss_module.weight.item() == 600.0
    state, expected = second.state_dict(), whole.state_dict()
    for key in ("finished", "changed_at", "fruitless", "accuracies"):
        assert state[key] == expected[key]
    assert torch.equal(second.prior.active(), whole.prior.active())
    assert state["history"]["coverage"] == expected["history"]["coverage"]
    assert part_trainer.modules == {"grow_skills": second}


def test_bad_arguments_are_refused_with_their_value() -> None:
    prior = GrowingSkillPrior(4)
    for kwargs, message in (
        ({"min_base_steps": 500, "max_base_steps": 400}, "max_base_steps >= 500; got 400"),
        ({"min_base_steps": 0}, "min_base_steps >= 1; got 0"),
        ({"window": 1}, "window >= 2; got 1"),
        ({"patience": 0}, "patience >= 1; got 0"),
        ({"min_gain": -0.1}, "min_gain >= 0.0.*; got -0.1"),
    ):
        with pytest.raises(ValueError, match=message):
            GrowSkills(prior, lambda: 0.0, **kwargs)  # type: ignore[arg-type]
    with pytest.raises(RuntimeError, match=r"grow\.register"):
        GrowSkills(prior, lambda: 0.0)()


# ---------------------------------------------------------------- coverage


def chain_planner(prior: Any, **kwargs: Any) -> tuple[MCTSPlanner, TensorDict]:
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    env = TransformedEnv(
        ChainEnv(length=9), Compose(OptionTransform(worker, 2, 1), SkillMaskTransform(prior))
    )
    budget = SearchBudget(base_steps=100, until_plan=kwargs.pop("until_plan", False))
    novelty = RadiusNovelty("state", 1.0, max_relaxations=0)
    planner = MCTSPlanner(env, budget=budget, **{"novelty": novelty, **kwargs})
    starts = env.reset().exclude("action_mask").unsqueeze(0).repeat(3)
    starts["state"] = torch.tensor([0, 2, 4]).view_as(starts["state"])
    return planner, starts


def test_coverage_counts_the_places_within_reach_of_the_skills_that_are_on() -> None:
    prior = FixedSkillPrior(2, [1.0, 0.0])  # option 0 goes left
    planner, starts = chain_planner(prior)
    coverage = SearchCoverage(planner, starts, prior)
    assert coverage() == pytest.approx((1 + 3 + 5) / 3)  # from the start to the left end
    assert coverage.base_steps == 1 + 3 + 5  # one step from each place
    prior.p.fill_(0.5)
    assert coverage() == 9.0
    assert "action_mask" not in starts.keys()


def test_searches_that_cannot_measure_coverage_are_refused() -> None:
    prior = FixedSkillPrior(2)
    for kwargs, message in (({"novelty": None}, "novelty"), ({"until_plan": True}, "until_plan")):
        planner, starts = chain_planner(prior, **kwargs)
        with pytest.raises(ValueError, match=message):
            SearchCoverage(planner, starts, prior)


# ---------------------------------------------------------------- in a trainer


def growing_worker(batches: int, save_dir: Path | None = None) -> tuple[DIAYNTrainer, GrowSkills]:
    """Skills two to five, of which a third adds coverage and a fourth does not."""
    prior = GrowingSkillPrior(5, 2)
    env = TransformedEnv(
        WaterworldMazeEnv(batch_size=[32], observation=False),
        Compose(SkillTransform(5, 1, prior=prior), DisplacementTransform()),
    )
    loss = DIAYNTrainer.make_loss(env, 5, seed=0, prior=prior)
    trainer = DIAYNTrainer(env, loss, total_frames=64 * batches, seed=0, save_dir=save_dir)
    grow = GrowSkills(
        prior,
        lambda: {2: 1.0, 3: 2.0, 4: 2.0}[int(prior.num_active)],
        patience=1,
        prune=False,
        min_base_steps=128,
        max_base_steps=128,
        window=2,
    )
    grow.register(trainer)
    return trainer, grow


def test_it_grows_a_worker_inside_diayn_trainer() -> None:
    trainer, grow = growing_worker(12)

    def all_heads() -> torch.Tensor:  # [Z, ...] of the actor
        heads = trainer.loss_module.actor_network.network.heads
        return heads.weight.detach().clone().view(5, -1)

    heads, weights = all_heads(), []
    trainer.register_op("post_steps", lambda: weights.append(all_heads()))
    trainer.train()
    assert grow.history["better"] == [True, True, False]
    assert int(grow.prior.num_active) == 3
    # Three skills were best after 256 base steps, the fourth batch; the sixth tried a fourth.
    assert torch.equal(weights[5], weights[3])
    moved = (weights[4] != heads).any(-1)
    assert moved.tolist() == [True, True, True, True, False]
    stored = trainer.replay_buffer.storage[:]["skill"]
    assert stored.shape == (64 * 6,)  # of the batches since
    # The step after a skill is switched off still executes it.
    assert int(stored[64:].max()) == 2
    for values in trainer.history.values():
        assert all(map(math.isfinite, values))
    assert trainer.history["num_active_skills"] == [2, 2, 3, 3, 4, 4, *[3] * 6]


def test_a_resumed_run_is_the_same_as_one_that_never_stopped(tmp_path: Path) -> None:
    whole, expected = growing_worker(8)
    whole.train()
    growing_worker(5, tmp_path)[0].train()  # ends while the fourth skill is on trial
    resumed, grow = growing_worker(8, tmp_path)
    resumed.load(tmp_path)
    assert int(grow.prior.num_active) == 4
    resumed.train()
    assert grow.history["better"] == expected.history["better"] == [True, True, False]
    assert int(grow.prior.num_active) == 3
    states = [t.loss_module.state_dict() for t in (resumed, whole)]
    assert differences(*states) == []
