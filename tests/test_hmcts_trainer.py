"""HMCTSTrainer, on a point in an open box with a goal line."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_trainers import Bars, differences, weights
from tensordict import TensorDict, TensorDictBase
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    LazyTensorStorage,
    ReplayBuffer,
    Unbounded,
)
from torchrl.envs import EnvBase

from torchrl_hmcts.planners import MCTSPlanner, SearchBudget
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.evaluation import Results
from torchrl_hmcts.trainers.hmcts import HMCTSTrainer
from torchrl_hmcts.trainers.skills.dataset import load_dataset
from torchrl_hmcts.trainers.skills.rounds import RoundRecords

STEPS = torch.tensor([[0.0, -1.0], [0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]])


class Walk(EnvBase):
    """A point that moves one tile per step in a box of 9 x 9; its goal is the right wall."""

    batch_locked = False

    def __init__(self, batch_size: Sequence[int] = ()) -> None:
        super().__init__(batch_size=torch.Size(batch_size))
        shape = self.batch_size
        spec = {
            "position": Bounded(0.0, 8.0, shape=(*shape, 2)),
            "velocity": Unbounded((*shape, 2)),
        }
        self.observation_spec = Composite(spec, shape=shape)
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Categorical(4, shape=shape)
        self.reward_spec = Unbounded((*shape, 1))
        done = Binary(1, shape=(*shape, 1), dtype=torch.bool)
        self.done_spec = Composite(done=done, terminated=done.clone(), shape=shape)
        self.generator = torch.Generator()
        self.base_steps = 0  # that were really taken

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed)

    def _reset(self, td: TensorDictBase | None, **kwargs: Any) -> TensorDict:
        shape = self.batch_size if td is None else td.batch_size
        position = torch.randint(8, (*shape, 2), generator=self.generator).float()
        entries = {"position": position, "velocity": torch.zeros_like(position)}
        return TensorDict(entries, batch_size=shape)

    def _step(self, td: TensorDictBase) -> TensorDict:
        self.base_steps += td.numel()
        position = (td["position"] + STEPS[td["action"]]).clamp(0.0, 8.0)
        reached = position[..., :1] == 8.0
        return TensorDict(
            {
                "position": position,
                "velocity": position - td["position"],
                "reward": reached.float(),
                "done": reached,
                "terminated": reached.clone(),
            },
            batch_size=td.batch_size,
        )


class Displaced(Walk):  # the trainer's recorder writes displacement; its size is all we need
    @property
    def full_observation_spec_unbatched(self) -> Composite:
        spec = super().full_observation_spec_unbatched.clone()
        spec["displacement"] = Unbounded((2,))
        return spec


def make_trainer(make_env: Callable[[], EnvBase] = Walk, **kwargs: Any) -> HMCTSTrainer:
    settings: dict[str, Any] = {
        "rounds": 11,
        "num_init_samples": 5,
        "retrain_interval": 2,
        "option_steps": 3,
        "batch_size": 16,
        "make_planner": partial(MCTSPlanner, budget=SearchBudget(expansions=4)),
    }
    loss = DIAYNTrainer.make_loss(Displaced(), 4, hidden=(8, 8), seed=0)
    return HMCTSTrainer(make_env, loss, **{**settings, **kwargs})


def trained(make_env: Callable[[], EnvBase] = Walk, **kwargs: Any) -> HMCTSTrainer:
    trainer = make_trainer(make_env, **kwargs)
    trainer.train()
    return trainer


def always(action: int) -> Callable[[TensorDictBase], TensorDictBase]:
    return lambda td: td.set("action", torch.full(td.batch_size, action))


@pytest.fixture(scope="module")
def recorded() -> TensorDict:
    """40 transitions of options from here."""
    return trained(rounds=40, num_init_samples=40).replay_buffer[:][:40]


def test_it_trains_when_the_interval_divides_the_round_and_at_no_other_time() -> None:
    bars = Bars()
    trainer = trained(rounds=5 + 7, retrain_interval=3, progress=bars)
    assert trainer.retrained_at == [0, 3, 6]
    assert trainer.records.columns["round"].tolist() == [0, 1, 2, 3, 4, 5, 6]
    steps = trainer.records.columns["training_steps"]
    assert [len(set(steps[i : i + 3])) for i in (0, 3)] == [1, 1]
    assert np.all(np.diff(steps[::3]) > 0)
    assert len(trainer.history["loss_actor"]) == 3
    (bar,) = bars  # of rounds
    assert (bar.total, bar.n, bar.closed) == (7, 7, True)
    assert set(bar.figures) == {"solved", "base_steps", "simulated_steps", "executed_steps"}


def test_every_base_step_that_an_env_took_is_counted_and_stored() -> None:
    envs: list[Walk] = []

    def make_env() -> Walk:
        envs.append(Walk())
        return envs[-1]

    trainer = make_trainer(make_env)
    built = [env.base_steps for env in envs]
    trainer.train()
    real, simulated = (env.base_steps - n for env, n in zip(envs, built, strict=True))
    columns = trainer.records.columns
    assert real == columns["executed_steps"].sum() + trainer.collector.init_steps
    assert simulated == columns["simulated_steps"].sum() > 0
    assert trainer.collected_frames == trainer.collector.training_steps == real + simulated
    data = trainer.replay_buffer[:]
    assert len(data) == real + simulated
    assert set(data.keys(True, True)) == set(trainer.loss_module.in_keys)
    moved = data["next", "displacement"] - data["displacement"]
    torch.testing.assert_close(moved, data["next", "velocity"])


def test_the_first_samples_are_as_many_options_with_skills_of_all_kinds() -> None:
    trainer = trained(rounds=64, num_init_samples=64, option_steps=1)
    data = trainer.replay_buffer[:]
    assert len(data) == trainer.collected_frames == trainer.collector.init_steps == 64
    assert data["skill"].bincount(minlength=4).min() > 64 / 4 / 3
    assert not data["displacement"].any()
    assert len(trainer.records) == 0
    assert trainer.retrained_at == [0]


def test_the_worker_is_trained_on_a_dataset_before_the_first_samples(recorded: TensorDict) -> None:
    for dataset, expected in ((None, 0), (recorded, 7)):
        optimised: list[int] = []
        trainer = make_trainer(dataset=dataset, pretrain_updates=7)
        trainer.register_op(
            "batch_process", lambda batch, t=trainer, n=optimised: n.append(t._optim_count)
        )
        trainer.train()
        assert optimised[0] == expected


@pytest.mark.parametrize(("fraction", "share"), [(0.25, 0.25), (1.0, 1.0), (0.0, 0.0), (None, 0.5)])
def test_batches_mix_samples_and_dataset_in_the_given_share(
    fraction: float | None, share: float, recorded: TensorDict
) -> None:
    dataset = recorded.clone()
    dataset["velocity"] = torch.full_like(dataset["velocity"], 77.0)
    trainer = make_trainer(dataset=dataset, dataset_fraction=fraction, batch_size=4000)
    trainer.replay_buffer.extend(recorded)
    (sample, _), *_ = trainer._process_optim_batch_ops
    drawn = sample(None)
    found = float((drawn["velocity"][:, 0] == 77.0).float().mean())
    assert found == pytest.approx(share, abs=0.0 if fraction is not None else 0.05)
    assert ("next", "reward") in drawn.keys(True)
    assert len(drawn) == 4000


@pytest.mark.parametrize("form", ["memmap", "dumps", "buffer", "grid", "empty"])
def test_a_dataset_is_the_same_in_every_form(
    form: str, tmp_path: Path, recorded: TensorDict
) -> None:
    data: Any = recorded
    source: Any = tmp_path
    if form in ("memmap", "grid"):
        (data.reshape(4, 10) if form == "grid" else data).memmap(tmp_path)
    else:
        source = ReplayBuffer(storage=LazyTensorStorage(50))
        if form == "empty":
            data = None
        else:
            source.extend(data)
        if form == "dumps":
            source.dumps(tmp_path)
            source = str(tmp_path)
    if data is not None:
        assert (load_dataset(source, list(data.keys(True, True))) == data).all()
    runs = [weights(trained(dataset=given, pretrain_updates=2)) for given in (source, data)]
    assert torch.equal(*runs)


def test_a_worker_that_goes_right_solves_every_test_in_a_known_number_of_steps() -> None:
    trainer = trained(
        rounds=6,
        make_test_env=Walk,
        test_worker=always(3),
        test_rounds=9,
        option_steps=8,
        make_test_planner=partial(MCTSPlanner, budget=SearchBudget(expansions=1)),
    )
    curve = trainer.test_records.curve()
    distance = 8.0 - trainer._test_starts["position"][:, 0].mean().item()
    assert curve["training_steps"][0] == 0.0
    assert curve["solved"].tolist() == [1.0, 1.0]
    assert curve["executed_steps"] == pytest.approx([distance, distance])
    # One expansion simulates all four options, each of which goes right.
    assert curve["simulated_steps"] == pytest.approx([4 * distance, 4 * distance])
    assert curve["base_steps"] == pytest.approx([5 * distance, 5 * distance])
    assert trainer.history["test/solved"] == [1.0, 1.0]


def test_an_unsolved_round_counts_with_what_it_cost() -> None:
    curve = trained(worker=always(2), rounds=7).records.curve()  # to the left
    assert curve["solved"].tolist() == [0.0]
    assert curve["simulated_steps"].tolist() == [4 * 4 * 3]  # expansions, options, base steps
    assert curve["executed_steps"].tolist() == [0.0]


def test_the_curve_means_over_the_rounds_of_one_worker() -> None:
    records = RoundRecords()
    for steps, solved, simulated in ((10, [1, 0], [30, 50]), (20, [1], [4])):
        ones = np.ones(len(solved), dtype=np.int64)
        results = Results(ones > 0, np.array(solved) > 0, np.array(simulated), *[ones] * 4)
        records.add(results, np.arange(len(solved)), steps)
    curve = {name: values.tolist() for name, values in records.curve().items()}
    assert curve == {
        "training_steps": [10.0, 20.0],
        "rounds": [2.0, 1.0],
        "solved": [0.5, 1.0],
        "base_steps": [41.0, 5.0],
        "simulated_steps": [40.0, 4.0],
        "executed_steps": [1.0, 1.0],
    }


def test_base_steps_end_the_training_when_they_are_limited_and_again_when_it_is_resumed(
    tmp_path: Path,
) -> None:
    settings: dict[str, Any] = {"rounds": 100, "total_frames": 200, "save_dir": tmp_path}
    trainer = trained(**settings)
    assert trainer.collected_frames >= 200
    assert 0 < trainer.collector.round < 95
    assert trainer.collected_frames - trainer.records.columns["simulated_steps"][-2:].sum() < 200
    again = make_trainer(**settings).load(tmp_path)
    again.train()
    assert again.collected_frames == trainer.collected_frames
    assert torch.equal(weights(again), weights(trainer))


def test_the_same_seed_gives_the_same_run_whatever_was_drawn_before() -> None:
    runs = []
    for seed in (0, 0, 1):
        torch.rand(len(runs) + 1)
        before = torch.get_rng_state()
        runs.append(weights(trained(seed=seed)))
        assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


def resumable(folder: Path, rounds: int, saved: str) -> HMCTSTrainer:
    return make_trainer(
        rounds=rounds,
        make_test_env=Walk,
        test_rounds=3,
        save_dir=folder / saved,
        dataset=folder / "data",
        buffer_size=300,
        dataset_fraction=0.25,
    )


def everything(trainer: HMCTSTrainer) -> dict[str, Any]:
    return {
        "loss": trainer.loss_module.state_dict(),
        "optimizer": trainer.optimizer.state_dict(),
        "buffer": trainer.replay_buffer[:].to_dict(),
        "cursor": trainer.replay_buffer.writer._cursor,
        "counts": [trainer.collected_frames, trainer._optim_count, len(trainer.replay_buffer)],
        "history": trainer.history,
        "retrained": trainer.retrained_at,
        "rounds": trainer.records.state_dict(),
        "tests": trainer.test_records.state_dict(),
    }


def test_a_run_resumed_in_a_new_process_is_the_unbroken_run_bit_for_bit(
    tmp_path: Path, recorded: TensorDict
) -> None:
    recorded.memmap(tmp_path / "data")
    half = resumable(tmp_path, 5 + 4, "half")
    half.train()
    subprocess.run([sys.executable, __file__, str(tmp_path)], check=True, timeout=300)
    resumed = torch.load(tmp_path / "resumed.pt")
    trainer = resumable(tmp_path, 5 + 8, "unbroken")
    trainer.train()
    assert trainer.collected_frames > 300 == len(trainer.replay_buffer)  # it has turned over
    assert not torch.equal(weights(trainer), weights(half))
    assert differences(everything(trainer), resumed) == []


def test_what_would_change_the_run_is_refused_when_resuming(tmp_path: Path) -> None:
    trained(save_dir=tmp_path)
    with pytest.raises(Exception, match="retrain_interval=2; this trainer has 3"):
        make_trainer(retrain_interval=3).load(tmp_path)
    with pytest.raises(Exception, match="seed=0; this trainer has 1"):
        make_trainer(seed=1).load(tmp_path)
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        make_trainer().load(tmp_path / "elsewhere")


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"rounds": 4}, "rounds >= 5; got 4. The rounds include num_init_samples"),
        ({"retrain_interval": 0}, "retrain_interval >= 1; got 0"),
        ({"num_init_samples": 0}, "num_init_samples >= 1; got 0"),
        ({"dataset_fraction": 1.5}, "dataset_fraction >= 0.0 and <= 1.0; got 1.5"),
        ({"dataset": TensorDict(x=torch.ones(2), batch_size=2)}, "lacks .*OptionRecorder"),
        ({"dataset": Path("nowhere")}, "no dataset in"),
        ({"dataset": 3}, "got int"),
    ],
)
def test_what_makes_no_sense_is_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError, FileNotFoundError), match=message):
        make_trainer(**kwargs)


def test_an_env_with_a_state_of_its_own_is_refused() -> None:
    class Locked(Walk):
        batch_locked = True

    with pytest.raises(ValueError, match="Locked is batch_locked"):
        make_trainer(Locked)


if __name__ == "__main__":
    place = Path(sys.argv[1])
    continued = resumable(place, 5 + 8, "half").load(place / "half")
    continued.train()
    torch.save(everything(continued), place / "resumed.pt")
