"""DIAYNTrainer, on a point in an open box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import Bounded, Categorical, Composite, LazyTensorStorage, ReplayBuffer, Unbounded
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.objectives import SoftUpdate
from torchrl.trainers.algorithms import SACTrainer

from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.objectives import DIAYNLoss
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.transforms import DIAYNReward, DisplacementTransform, SkillTransform

DIRECTIONS = torch.tensor([[0.0, -1.0], [0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]])


class PointMass(EnvBase):
    """Four thrusts push a point in a box of 9 x 9 tiles; walls stop it dead."""

    batch_locked = False

    def __init__(self, batch_size: Sequence[int] = ()) -> None:
        super().__init__(batch_size=torch.Size(batch_size))
        shape = self.batch_size
        spec = {
            "position": Bounded(0.0, 9.0, shape=(*shape, 2)),
            "velocity": Unbounded((*shape, 2)),
        }
        self.observation_spec = Composite(spec, shape=shape)
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Categorical(4, shape=shape)
        self.reward_spec = Unbounded((*shape, 1))
        self.generator = torch.Generator()

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed)

    def _reset(self, td: TensorDictBase | None, **kwargs: Any) -> TensorDict:
        shape = self.batch_size if td is None else td.batch_size
        position = 9.0 * torch.rand((*shape, 2), generator=self.generator)
        velocity = torch.zeros_like(position)
        return TensorDict({"position": position, "velocity": velocity}, batch_size=shape)

    def _step(self, td: TensorDictBase) -> TensorDict:
        velocity = td["velocity"]
        velocity = velocity + 0.05 * (4.0 * DIRECTIONS[td["action"]] - 2.0 * velocity)
        free = td["position"] + 0.05 * velocity
        position = free.clamp(0.0, 9.0)
        never = torch.zeros((*td.batch_size, 1), dtype=torch.bool)
        return TensorDict(
            {
                "position": position,
                "velocity": torch.where(position == free, velocity, 0.0),
                "reward": never.float(),
                "done": never,
                "terminated": never.clone(),
            },
            batch_size=td.batch_size,
        )


def make_env(copies: int = 32) -> TransformedEnv:
    return TransformedEnv(
        PointMass([copies]), Compose(SkillTransform(4, 50), DisplacementTransform())
    )


def make_trainer(seed: int = 0, **kwargs: Any) -> DIAYNTrainer:
    env = make_env()
    loss = DIAYNTrainer.make_loss(env, num_skills=4, seed=seed)
    return DIAYNTrainer(env, loss, seed=seed, **{"total_frames": 192, **kwargs})


def weights(trainer: DIAYNTrainer) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in trainer.loss_module.parameters()])


class Bar:
    """A progress bar that remembers what it was told."""

    def __init__(self, total: int) -> None:
        self.total, self.n, self.figures, self.closed = total, 0, {}, False

    def update(self, n: int) -> None:
        self.n += n

    def set_postfix(self, *, refresh: bool, **figures: str) -> None:
        self.figures = figures

    def close(self) -> None:
        self.closed = True


def test_three_batches_train_every_network_and_log_the_four_curves() -> None:
    bars: list[Bar] = []

    def progress(total: int) -> Bar:
        bars.append(Bar(total))
        return bars[-1]

    trainer = make_trainer(progress=progress)
    before = {k: v.clone() for k, v in trainer.loss_module.state_dict().items()}
    trainer.train()
    after = trainer.loss_module.state_dict()
    still = [k for k in before if torch.equal(before[k], after[k]) and before[k].ndim > 1]
    assert still == []
    history = trainer.history
    for curve in ("loss_actor", "qvalue_loss_0", "qvalue_loss_1", "loss_discriminator"):
        assert len(history[curve]) == 3
    assert len(trainer.replay_buffer) == 192
    assert history["optim_steps"] == [3, 6, 9]
    (bar,) = bars
    assert (bar.total, bar.n, bar.closed) == (192, 192, True)
    assert "discriminator_accuracy" in bar.figures


def test_without_a_progress_bar_nothing_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    make_trainer().train()
    out, err = capsys.readouterr()
    assert "it/s" not in out + err


def test_the_same_seed_gives_the_same_weights() -> None:
    runs = []
    for seed in (0, 0, 1):
        torch.rand(len(runs) + 1)  # whatever the global generator went through before
        trainer = make_trainer(seed)
        trainer.train()
        runs.append(weights(trainer))
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


def test_only_what_the_loss_reads_is_stored_and_truncation_is_not_invented() -> None:
    trainer = make_trainer()
    trainer.train()
    stored = trainer.replay_buffer.storage[:]
    assert ("next", "displacement") in stored.keys(True)
    assert ("next", "position") not in stored.keys(True)
    assert not stored["next", "done"].any()


def test_a_batch_must_divide_among_the_copies() -> None:
    with pytest.raises(ValueError, match="multiple of 32; got 40"):
        make_trainer(frames_per_batch=40)


def test_a_missing_entry_is_named() -> None:
    with pytest.raises(KeyError, match="speed"):
        DIAYNTrainer.make_loss(make_env(), in_keys=["speed"])


@pytest.mark.filterwarnings("ignore:SACTrainer is an experimental:UserWarning")
@pytest.mark.filterwarnings("ignore:The 'post_loss' hook stage:FutureWarning")
@pytest.mark.filterwarnings("ignore:The 'optimizer' hook stage:FutureWarning")
def test_the_loss_runs_in_torchrls_own_sac_trainer() -> None:
    env = make_env(16)
    loss = DIAYNTrainer.make_loss(env, num_skills=4)
    collector = Collector(
        env,
        loss.actor_network,
        frames_per_batch=64,
        total_frames=192,
        auto_register_policy_transforms=False,
    )
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(1000), transform=DIAYNReward(loss.discriminator, 4), batch_size=32
    )
    before = [p.detach().clone() for p in loss.parameters()]
    SACTrainer(
        collector=collector,
        total_frames=192,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters()),
        replay_buffer=buffer,
        batch_size=32,
        target_net_updater=SoftUpdate(loss, tau=0.05),
        progress_bar=False,
        enable_logging=False,
    ).train()
    changed = [not torch.equal(a, b) for a, b in zip(before, loss.parameters(), strict=True)]
    assert all(changed)


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
