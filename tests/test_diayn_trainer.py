"""DIAYNTrainer, on a point in an open box."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_trainers import Bars, weights
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.objectives import DiscreteSACLoss
from torchrl.record import CSVLogger

from torchrl_hmcts.modules import SkillEncoder, SkillPolicy
from torchrl_hmcts.objectives import DIAYNLoss, METRAEncoderLoss
from torchrl_hmcts.testing import PointMassEnv
from torchrl_hmcts.trainers.diayn import DIAYNTrainer, make_skill_optimizer
from torchrl_hmcts.trainers.skills.coverage import StateCoverage
from torchrl_hmcts.transforms import (
    DisplacementTransform,
    SkillTransform,
)

CURVES = ("actor_loss", "critic_1_loss", "critic_2_loss", "discriminator_loss", "entropy")


def make_env(copies: int = 32) -> TransformedEnv:
    return TransformedEnv(
        PointMassEnv([copies]), Compose(SkillTransform(4, 50), DisplacementTransform())
    )


def make_trainer(seed: int = 0, **kwargs: Any) -> DIAYNTrainer:
    env = make_env()
    loss = DIAYNTrainer.make_loss(env, num_skills=4, seed=seed)
    return DIAYNTrainer(env, loss, seed=seed, **{"total_frames": 192, **kwargs})


def test_three_batches_train_every_network_log_the_curves_and_store_what_is_read() -> None:
    bars = Bars()
    trainer = make_trainer(progress=bars)
    before = {k: v.clone() for k, v in trainer.loss_module.state_dict().items()}
    trainer.train()
    after = trainer.loss_module.state_dict()
    assert [k for k in before if torch.equal(before[k], after[k]) and before[k].ndim > 1] == []
    history = trainer.history
    for curve in (*CURVES, "discriminator_accuracy", "state_coverage"):
        assert len(history[curve]) == 3
    assert history["optim_steps"] == [3, 6, 9]
    (bar,) = bars
    assert (bar.total, bar.n, bar.closed) == (192, 192, True)
    assert "accuracy" in bar.figures
    stored = trainer.replay_buffer.storage[:]
    assert len(stored) == 192
    assert ("next", "displacement") in stored.keys(True)
    assert ("next", "position") not in stored.keys(True)
    assert not stored["next", "done"].any()  # no truncation is invented
    # Curves are found by the names of the loss too.
    assert history["qvalue_loss_1"] == history["critic_2_loss"]
    assert "qvalue_loss_1" not in list(history)
    total = np.add(history["critic_1_loss"], history["critic_2_loss"])
    assert np.allclose(total, history["critic_loss"])
    with pytest.raises(KeyError, match="'speed' was not logged; there are .*'actor_loss'"):
        history["speed"]


@pytest.mark.parametrize(("interval", "logged"), [(0, [64, 128, 192]), (100, [128])])
def test_curves_reach_a_logger_with_base_steps_as_x(
    interval: int, logged: list[int], tmp_path: Path
) -> None:
    logger = CSVLogger("run", str(tmp_path))
    trainer = make_trainer(logger=logger, log_interval=interval)
    trainer.train()
    for file in logger.experiment.files.values():  # TorchRL leaves them to the garbage collector
        file.close()
    for curve in (*CURVES, "state_coverage"):
        file = tmp_path / "run" / "scalars" / f"{curve}.csv"
        rows = np.loadtxt(file, delimiter=",", ndmin=2)
        assert rows[:, 0].tolist() == logged
        values = [trainer.history[curve][step // 64 - 1] for step in logged]
        assert np.allclose(rows[:, 1], values)


def test_coverage_counts_the_cells_of_the_entry_it_is_given() -> None:
    coverage = StateCoverage("position", cell_side=9.0)
    trainer = make_trainer(coverage=coverage)
    trainer.train()
    # Cells as large as the box: its inside is one, and a wall at 9 belongs to the next.
    assert 1 <= trainer.history["state_coverage_total"][-1] <= 4
    assert ("next", "position") in trainer.replay_buffer.storage[:].keys(True)


def visit(coverage: StateCoverage, *cells: tuple[float, float]) -> tuple[float, float]:
    moved = TensorDict(displacement=torch.tensor(cells), batch_size=[len(cells)])
    counts = coverage(TensorDict(next=moved, batch_size=[len(cells)]))
    return counts["state_coverage"], counts["state_coverage_total"]


def test_coverage_forgets_what_left_the_window_but_not_since_the_start() -> None:
    coverage = StateCoverage(cell_side=0.5, window=4)
    coverage.load_state_dict(StateCoverage().state_dict())  # of one that has seen nothing
    assert visit(coverage, (0.1, 0.1), (0.6, 0.1)) == (2, 2)
    assert visit(coverage, (0.4, 0.4), (-0.1, 0.1)) == (3, 3)  # -0.1 is in the cell below 0
    assert visit(coverage, (0.1, 0.1), (0.1, 0.1)) == (2, 3)  # (0.6, 0.1) is forgotten
    copy = StateCoverage(cell_side=0.5, window=4)
    copy.load_state_dict(coverage.state_dict())
    for counter in (coverage, copy):
        assert visit(counter, (0.9, 0.1), (5.0, 5.0)) == (3, 4)


def test_another_objective_trains_in_the_same_trainer() -> None:
    env = make_env()
    objective = METRAEncoderLoss(SkillEncoder(2, num_skills=4, in_keys=["position"]))
    loss = DIAYNTrainer.make_loss(env, 4, objective=objective, critic_keys=["position"])
    before = {name: p.detach().clone() for name, p in loss.named_parameters()}
    trainer = DIAYNTrainer(env, loss, total_frames=128, seed=0)
    trainer.train()
    # The bias of the encoder's last layer cancels in what METRA looks at, phi(s') - phi(s).
    (still,) = [name for name, p in loss.named_parameters() if torch.equal(p, before[name])]
    assert still.startswith("objective.encoder")
    assert still.endswith("bias")
    assert len(trainer.history["encoder_loss"]) == 2
    # Nothing of a discriminator is left; coverage is counted where the encoder looks.
    assert not [name for name in trainer.history if "discriminator" in name]
    assert trainer.history["state_coverage_total"][-1] >= 32


def test_what_cannot_be_trained_is_refused() -> None:
    env = make_env()
    nets = DIAYNTrainer.make_loss(env, 4)
    loss = DiscreteSACLoss(
        nets.actor_network, nets.qvalue_network, action_space="categorical", num_actions=4
    )
    with pytest.raises(TypeError, match="DiscreteSACLoss has none"):
        DIAYNTrainer(env, loss)
    with pytest.raises(ValueError, match="multiple of 32; got 40"):
        make_trainer(frames_per_batch=40)
    with pytest.raises(KeyError, match="speed"):
        DIAYNTrainer.make_loss(env, in_keys=["speed"])
    with pytest.raises(ValueError, match=r"cell_side .*> 0.0.*; got 0"):
        StateCoverage(cell_side=0)
    with pytest.raises(ValueError, match="window >= 1; got 0"):
        StateCoverage(window=0)


def test_the_optimiser_trains_every_parameter_once_with_the_rate_of_its_part() -> None:
    loss = DIAYNTrainer.make_loss(make_env(), 4, fixed_alpha=False)
    groups = make_skill_optimizer(loss, 0.1, 0.2, 0.3, 0.4).param_groups
    rates = {"actor": 0.1, "critic": 0.2, "objective": 0.3, "alpha": 0.4}
    assert {g["name"]: g["lr"] for g in groups} == rates
    trained = [id(p) for g in groups for p in g["params"]]
    assert len(trained) == len(set(trained))
    assert set(trained) == {id(p) for p in loss.parameters() if p.requires_grad}


def test_targets_move_by_tau_towards_the_critics() -> None:
    trainer = make_trainer(target_tau=0.25)
    loss = trainer.loss_module
    old = loss.target_qvalue_network_params.clone()
    for p in loss.qvalue_network_params.parameters():
        p.data.add_(1.0)
    trainer._post_optim_hook()
    for key, value in loss.target_qvalue_network_params.items(True, True):
        assert torch.allclose(value, old[key] + 0.25)
    trainer.collector.shutdown()


def test_the_same_seed_gives_the_same_weights_and_prints_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    runs = []
    for seed in (0, 0, 1):
        torch.rand(len(runs) + 1)  # the global generator's past does not matter
        trainer = make_trainer(seed)
        trainer.train()
        runs.append(weights(trainer))
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])
    assert "it/s" not in "".join(capsys.readouterr())


@torch.no_grad()
def displacements(loss: DIAYNLoss, per_skill: int = 64) -> tuple[torch.Tensor, float]:
    """Returns the skills' mean displacements ``[4, 2]`` after 50 steps, and the accuracy then."""
    env, policy = make_env(4 * per_skill), SkillPolicy(loss.actor_network)
    env.set_seed(123)
    skill = torch.arange(4).repeat_interleave(per_skill)
    td = env.reset(TensorDict(skill=skill, batch_size=[4 * per_skill]))
    end = env.rollout(50, policy, auto_reset=False, tensordict=td)[:, -1]["next"]
    guess = loss.discriminator(end.select("displacement"))["skill_logits"].argmax(-1)
    moved = end["displacement"].view(4, per_skill, 2).mean(1)
    return moved, float((guess == skill).float().mean())


def test_skills_become_distinguishable_within_a_short_run() -> None:
    trainer = make_trainer(total_frames=12_800)
    _, before = displacements(trainer.loss_module)
    trainer.train()
    moved, accuracy = displacements(trainer.loss_module)
    assert before < 0.5
    assert accuracy > 0.6  # chance is 0.25; the full 40,000 steps are measured elsewhere
    assert moved.norm(dim=-1).max() > 0.5
