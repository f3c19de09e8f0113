"""Training that is saved and resumed, and what a checkpoint holds."""

from __future__ import annotations

import random
import subprocess
import sys
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_trainers import differences
from torch import nn
from torchrl.checkpoint import CheckpointError, CheckpointRotation, GlobalRNGState
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, GymEnv, SerialEnv, TransformedEnv

from torchrl_hmcts.envs import SettableGymEnv, WaterworldMazeEnv
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.saving.run_state import GeneratorStates, RunningEpisodes
from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform

HALF = 16 * 7  # base steps: 14 of each copy, so that episodes of 10 end on the way


def make_env(copies: int = 8) -> TransformedEnv:
    base = WaterworldMazeEnv(batch_size=[copies], observation=False, max_steps=10)
    return TransformedEnv(base, Compose(SkillTransform(4, 5, seed=3), DisplacementTransform()))


def make_trainer(total: int, copies: int = 8, seed: int | None = None, **kw: Any) -> DIAYNTrainer:
    env = make_env(copies)
    loss = DIAYNTrainer.make_loss(env, 4, hidden=(8, 8), fixed_alpha=False)
    settings = {"frames_per_batch": 16, "batch_size": 32, "buffer_size": 128, **kw}
    return DIAYNTrainer(env, loss, total_frames=total, seed=seed, **settings)


def train(trainer: DIAYNTrainer) -> dict[str, Any]:
    """Trains, and returns everything on which what comes next depends."""
    end: dict[str, Any] = {}

    def look() -> None:  # before the collector is shut down
        end.update(
            loss=trainer.loss_module.state_dict(),
            optimizer=trainer.optimizer.state_dict(),
            buffer=trainer.replay_buffer.storage[:].to_dict(),
            cursor=trainer.replay_buffer.writer._cursor,
            rng=GlobalRNGState().state_dict(),
            counters=[trainer.collected_frames, trainer._optim_count, trainer._last_save],
            last_log=dict(trainer._last_log),
            history=dict(trainer.history),
            collector=trainer.collector.state_dict(),
            generators=trainer._modules["generators"].state_dict(),
            episodes=trainer._modules["running_episodes"].state_dict(),
            coverage=trainer._modules["state_coverage"].state_dict(),
        )
        torch.save(end, trainer.copy_of_end)

    trainer.register_op("shutdown", look)
    trainer.train()
    return torch.load(trainer.copy_of_end, weights_only=True)


def resume_in_this_process(folder: Path) -> None:
    trainer = make_trainer(2 * HALF, seed=99, save_dir=folder / "again", save_trainer_interval=60)
    trainer.load(folder / "checkpoints")
    trainer.copy_of_end = folder / "resumed.pt"
    train(trainer)


def test_a_run_resumed_in_a_new_process_ends_bit_for_bit_as_one_that_never_stopped(
    tmp_path: Path,
) -> None:
    saving = {"save_trainer_interval": 60}
    torch.manual_seed(1)
    whole = make_trainer(2 * HALF, seed=5, save_dir=tmp_path / "other", **saving)
    whole.copy_of_end = tmp_path / "whole.pt"
    expected = train(whole)
    torch.manual_seed(1)
    half = make_trainer(HALF, seed=5, save_dir=tmp_path / "checkpoints", **saving)
    half.copy_of_end = tmp_path / "half.pt"
    assert differences(train(half)["loss"], expected["loss"]) != []
    subprocess.run([sys.executable, __file__, str(tmp_path)], check=True, timeout=300)
    resumed = torch.load(tmp_path / "resumed.pt", weights_only=True)
    assert differences(resumed, expected) == []
    assert expected["counters"] == [224, 42, 192]
    assert len(expected["history"]["actor_loss"]) == 14


def test_a_checkpoint_holds_no_pickle_and_nothing_of_the_memory_that_the_buffer_has_not_filled(
    tmp_path: Path,
) -> None:
    trainer = make_trainer(32, save_dir=tmp_path)  # of 128 rows

    def leave_something(batch: Any) -> None:  # as another object does
        for tensor in trainer.replay_buffer.storage._storage[32:].values(True, True):
            tensor.copy_(torch.ones_like(tensor))

    trainer.register_op("pre_steps_log", leave_something)
    trainer.train()
    (checkpoint,) = tmp_path.iterdir()
    files = [Path(name) for name in zipfile.ZipFile(checkpoint).namelist()]
    assert {path.suffix for path in files} == {".json", ".memmap"}
    stored, again = (
        t.replay_buffer.storage._storage for t in (trainer, make_trainer(32).load(tmp_path))
    )
    assert (again[:32] == stored[:32]).all()
    assert not any(tensor.any() for tensor in again[32:].values(True, True))


def test_a_finished_run_can_be_given_more_base_steps(tmp_path: Path) -> None:
    make_trainer(32, save_dir=tmp_path).train()
    trainer = make_trainer(64).load(tmp_path)
    trainer.train()
    assert trainer.history["optim_steps"] == [3, 6, 9, 12]
    with pytest.raises(CheckpointError, match=r"batch size \[8\]; this one has \[4\]"):
        make_trainer(32, copies=4).load(tmp_path)
    with pytest.raises(FileNotFoundError, match="no checkpoint in .*nothing"):
        make_trainer(32).load(tmp_path / "nothing")


def test_the_checkpoints_of_another_run_are_refused_or_overwritten(tmp_path: Path) -> None:
    make_trainer(96, save_dir=tmp_path).train()
    other = make_trainer(32, save_dir=tmp_path)
    with pytest.raises(FileExistsError, match=r"of another run: .*096\.torchrl.*overwrite=True"):
        other.train()
    assert other.collected_frames == 0
    assert make_trainer(96).load(tmp_path).collected_frames == 96
    make_trainer(32, save_dir=tmp_path, overwrite=True).train()  # though its steps are fewer
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint-000000000032.torchrl"]


def test_a_run_that_continues_from_an_older_checkpoint_keeps_what_it_saves(tmp_path: Path) -> None:
    make_trainer(96, save_dir=tmp_path, save_trainer_interval=15).train()
    older, newest = sorted(tmp_path.iterdir())
    again = make_trainer(80 + 16, save_dir=tmp_path, keep_last=1).load(older)
    newest.rename(tmp_path / "checkpoint-000000000999.torchrl")  # as if it had come further
    again.train()
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint-000000000096.torchrl"]


def test_two_places_for_checkpoints_are_refused(tmp_path: Path) -> None:
    rotation = CheckpointRotation(tmp_path, keep_last=1)
    with pytest.raises(ValueError, match="to save_dir; leave checkpoint_rotation out"):
        make_trainer(32, save_dir=tmp_path, checkpoint_rotation=rotation)


def make_collector(env: Any) -> Collector:
    return Collector(
        env, frames_per_batch=8, total_frames=-1, auto_register_policy_transforms=False
    )


def test_episodes_of_a_collector_go_on_in_another() -> None:
    env, other = make_env(4), make_env(4)
    env.set_seed(0)
    collector = make_collector(env)
    collector.next()
    state = RunningEpisodes(collector).state_dict()
    expected = collector.next()
    copy = make_collector(other)
    RunningEpisodes(copy).load_state_dict(state)
    assert torch.equal(copy._carrier["position"], expected["position"][:, 0])
    assert copy._carrier["step_count"].flatten().tolist() == [2, 2, 2, 2]
    ids = [c._carrier["collector", "traj_ids"].tolist() for c in (collector, copy)]
    assert ids == [[0, 1, 2, 3]] * 2
    pools = [c._traj_pool.get_traj_and_increment(1).tolist() for c in (collector, copy)]
    assert pools[0] == pools[1]
    collector.shutdown()
    copy.shutdown()


def gym_env() -> EnvBase:
    return GymEnv("CartPole-v1", categorical_action_encoding=True)


def make_gym_trainer(
    total: int, folder: Path, make: Callable[[], EnvBase] = gym_env, **kw: Any
) -> DIAYNTrainer:
    env = TransformedEnv(make(), SkillTransform(4, 5, seed=3))
    keys = dict.fromkeys(("in_keys", "critic_keys", "discriminator_keys"), ["observation"])
    loss = DIAYNTrainer.make_loss(env, 4, hidden=(8,), seed=0, **keys)
    settings = {"frames_per_batch": 16, "batch_size": 8, "buffer_size": 64, "seed": 0, **kw}
    return DIAYNTrainer(env, loss, total_frames=total, save_dir=folder, **settings)


@pytest.mark.parametrize("new_episodes", [None, True])
def test_in_an_env_with_state_of_its_own_all_but_the_episodes_continues(
    new_episodes: bool | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    half = make_gym_trainer(32, tmp_path)
    half.train()
    saved = {"loss": half.loss_module.state_dict(), "adam": half.optimizer.state_dict()}
    again = make_gym_trainer(64, tmp_path, seed=7).load(tmp_path, new_episodes=new_episodes)
    loaded = {"loss": again.loss_module.state_dict(), "adam": again.optimizer.state_dict()}
    assert differences(loaded, saved) == []
    assert [again.collected_frames, again._optim_count, len(again.replay_buffer)] == [32, 6, 32]
    assert again._modules["running_episodes"].collector._carrier["skill_step"].item() == 0
    again.train()
    assert [again.collected_frames, again._optim_count] == [64, 12]
    said = "GymEnv keeps state of its own, so the episodes that were under way are left out"
    assert capsys.readouterr().err.count(said) == (new_episodes is None)


@pytest.mark.parametrize("copies", [0, 2])
def test_an_env_that_is_set_to_a_state_of_its_own_continues_its_episodes(
    copies: int, tmp_path: Path
) -> None:
    def make() -> EnvBase:
        one = partial(SettableGymEnv, "CartPole-v1", seed=0)
        return SerialEnv(copies, one) if copies else one()

    whole = make_gym_trainer(64, tmp_path / "whole", make)
    whole.train()
    make_gym_trainer(32, tmp_path / "half", make).train()
    again = make_gym_trainer(64, tmp_path / "half", make, seed=7).load(tmp_path / "half")
    again.train()
    assert differences(again.loss_module.state_dict(), whole.loss_module.state_dict()) == []
    assert differences(again.replay_buffer[:].to_dict(), whole.replay_buffer[:].to_dict()) == []


def test_episodes_that_cannot_continue_are_refused_on_request(tmp_path: Path) -> None:
    make_gym_trainer(32, tmp_path).train()
    with pytest.raises(CheckpointError, match=r"GymEnv keeps state.*new_episodes=True"):
        make_gym_trainer(64, tmp_path).load(tmp_path, new_episodes=False)


class Owner(nn.Module):
    def __init__(self, seed: int) -> None:
        super().__init__()
        self.inner = nn.Module()
        self.inner.generator = torch.Generator().manual_seed(seed)
        self.parts = [{"numpy": np.random.default_rng(seed)}, random.Random(seed)]
        self.itself = self

    def draw(self) -> list[float]:
        numpy, python = self.parts[0]["numpy"], self.parts[1]  # type: ignore[index]
        return [
            float(torch.rand((), generator=self.inner.generator)),
            float(numpy.random()),
            python.random(),
        ]


def test_all_kinds_of_generators_are_found_and_go_on_where_they_stood() -> None:
    one, two = Owner(0), Owner(1)
    one.draw()
    state = GeneratorStates(owner=one).state_dict()
    assert sorted(state) == [
        "owner._modules.inner.generator",
        "owner.parts.0.numpy",
        "owner.parts.1",
    ]
    GeneratorStates(owner=two).load_state_dict(state)
    assert two.draw() == one.draw()


def test_a_generator_that_is_missing_is_named() -> None:
    state = GeneratorStates(owner=Owner(0)).state_dict()
    with pytest.raises(ValueError, match="owner.parts.1"):
        GeneratorStates(owner=nn.Module()).load_state_dict(state)


if __name__ == "__main__":
    resume_in_this_process(Path(sys.argv[1]))
