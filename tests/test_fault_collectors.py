"""Processes that collect and die are started again; when they go on dying, an error says so.

``python tests/test_fault_collectors.py FOLDER`` trains with a local Ray cluster and kills.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector

from torchrl_hmcts.trainers.collectors import CollectorError, RestartingCollector
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env

BATCH, TOTAL = 64, 640


class Death(Exception):
    """What a collector raises when a process of it is gone."""


class Mortal:
    """A collector of batches of 4 that dies when it is asked for one of the given batches."""

    def __init__(self, frames: int, dies_at: int = -1) -> None:
        self.frames, self.dies_at, self.dead, self.closed = frames, dies_at, False, False
        self.init_random_frames = 0

    def __iter__(self) -> Iterator[TensorDict]:
        for i in range(-(-self.frames // 4)):
            if self.dead or i == self.dies_at:
                self.dead = True
                raise Death(f"at {i}\nwith details")
            yield TensorDict(batch_size=[4])

    def state_dict(self) -> dict[str, int]:
        if self.dead:
            raise Death("gone")
        return {"frames": self.frames}

    update_policy_weights_ = state_dict

    def shutdown(self) -> None:
        self.closed = True


def mortals(*dies_at: int, frames: int = 40) -> tuple[RestartingCollector, list]:
    made: list[Mortal] = []

    def make(left: int, deaths: int) -> Mortal:
        assert deaths == len(made)
        made.append(Mortal(left, dies_at[deaths] if deaths < len(dies_at) else -1))
        return made[-1]

    def died(collector: Any, error: Exception) -> bool:
        return isinstance(error, Death)

    return RestartingCollector(make, died, frames), made


def test_the_frames_that_are_left_are_collected_after_each_death(capsys: Any) -> None:
    collector, made = mortals(3, 0, 2)
    assert len(list(collector)) == 10
    assert [m.frames for m in made] == [40, 28, 28, 20]
    assert [m.closed for m in made] == [True, True, True, False]
    assert collector.num_restarts == 3
    said = capsys.readouterr().err.splitlines()
    assert said == [
        f"A process that collects died (Death: at {i}); it is started again." for i in (3, 0, 2)
    ]


def test_a_death_outside_of_collecting_is_noticed_too() -> None:
    collector, made = mortals()
    frames = 0
    for batch in collector:
        frames += batch.numel()
        if frames == 12:
            made[0].dead = True
        collector.update_policy_weights_()
    assert frames == 40
    assert [m.frames for m in made] == [40, 28]
    assert collector.state_dict() == {"frames": 28}
    collector.shutdown()
    assert made[1].closed
    assert collector.init_random_frames == 0


def test_deaths_without_a_batch_between_them_end_in_an_error() -> None:
    collector, made = mortals(2, 0, 0, 0, 0)
    with pytest.raises(
        CollectorError, match=r"Death: at 0\), 4 times without a batch.*after 8 base"
    ):
        list(collector)
    assert len(made) == 4


def test_training_that_ends_so_names_its_last_checkpoint(tmp_path: Path) -> None:
    class Short(Collector):
        def iterator(self) -> Iterator[TensorDict]:
            for i, batch in enumerate(super().iterator()):
                if i == 2:
                    raise Death("of the machine")
                yield batch

    def make_collector(*args: Any, **kwargs: Any) -> RestartingCollector:
        def make(left: int, deaths: int) -> Collector:
            if deaths:
                raise Death("of the machine")
            return Short(*args, **kwargs)

        return RestartingCollector(make, lambda c, error: isinstance(error, Death), TOTAL)

    trainer = make_trainer(tmp_path, make_collector)
    newest = tmp_path / f"checkpoint-{2 * BATCH:012d}.torchrl"
    with pytest.raises(CollectorError, match=f"4 times.*The last good checkpoint is '{newest}'"):
        trainer.train()

    def make_healthy(*args: Any, **kwargs: Any) -> RestartingCollector:
        return RestartingCollector(lambda *_: Collector(*args, **kwargs), lambda *_: False, TOTAL)

    again = make_trainer(tmp_path, make_healthy)
    assert again.collected_frames == 2 * BATCH
    again.train()
    assert again.collected_frames == TOTAL


def test_the_command_line_says_how_to_go_on(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    from torchrl_hmcts.trainers.cli import main

    def dies(config: Any) -> dict:
        raise CollectorError("A process that collects died (Death).")

    monkeypatch.setattr("torchrl_hmcts.trainers.experiments.skills.run_skills", dies)
    assert main(["train", "experiment=labmaze", f"out={tmp_path}"]) == 1
    said = capsys.readouterr().err
    again = f"Or continue with: hmcts train resume={tmp_path}"
    assert f"A process that collects died (Death). {again}" in said
    assert json.loads((tmp_path / "run.json").read_text())["status"] == "failed"


def make_trainer(folder: Path, make_collector: Any) -> DIAYNTrainer:
    env = make_training_env(copies=8)
    loss = DIAYNTrainer.make_loss(env, seed=0)
    trainer = DIAYNTrainer(
        env,
        loss,
        total_frames=TOTAL,
        frames_per_batch=BATCH,
        batch_size=32,
        seed=0,
        make_collector=make_collector,
        save_dir=folder,
        save_trainer_interval=0,
    )
    if any(folder.glob("checkpoint-*")):
        trainer.load(folder)
    return trainer


# ---------------------------------------------------------------- processes of a Ray cluster


def collecting_processes() -> list[int]:
    """Ids of the processes below this one in which a Ray actor collects."""
    parents: dict[int, int] = {}
    names: dict[int, bytes] = {}
    for place in Path("/proc").iterdir():
        if place.name.isdigit():
            try:
                stat = (place / "stat").read_text()
                names[int(place.name)] = (place / "cmdline").read_bytes()
            except OSError:  # it has just ended
                continue
            parents[int(place.name)] = int(stat.rsplit(")", 1)[1].split()[1])

    def mine(pid: int) -> bool:
        return pid == os.getpid() or (pid in parents and mine(parents[pid]))

    return [pid for pid, name in names.items() if name.startswith(b"ray::Collector") and mine(pid)]


def kill() -> int:
    """Kill what collects; return how many processes."""
    pids = collecting_processes()
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    return len(pids)


def train_and_kill(folder: Path) -> dict[str, int]:
    from torchrl_hmcts.trainers.collectors import make_ray_collector

    torch.set_num_threads(1)
    trainer = make_trainer(folder, make_ray_collector)
    killed = 0

    def look(*_: Any) -> None:
        nonlocal killed
        # One death while the weights are on their way, one while the next batch is.
        if trainer.collected_frames in (2 * BATCH, 5 * BATCH):
            killed += kill()

    trainer.register_op("pre_steps_log", look)
    trainer.train()
    restarts = trainer.collector.num_restarts
    return {"killed": killed, "base_steps": trainer.collected_frames, "restarts": restarts}


@pytest.mark.slow
def test_a_killed_process_of_a_ray_cluster_is_started_again(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "RAY_AUTH_MODE": "disabled"}
    environment.pop("RAY_ADDRESS", None)
    words = [sys.executable, __file__, str(tmp_path)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert result == {"killed": 2, "base_steps": TOTAL, "restarts": 2}


if __name__ == "__main__":
    print(json.dumps(train_and_kill(Path(sys.argv[1]))), flush=True)
    os._exit(0)  # without waiting for the cluster
