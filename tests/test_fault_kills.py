"""A run that is killed again and again loses at most the work since its last checkpoint.

``python tests/test_fault_kills.py FOLDER KILLS KIND`` does it by itself and prints what happened;
KIND is DIAYN (default) or HMCTS. It imports everything once; each life is a fork of that process.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

BATCH, TOTAL = 16, 16 * 400  # base steps; a checkpoint after every batch


def make_trainer(folder: Path, kind: str = "DIAYN") -> Any:
    if kind == "HMCTS":
        from test_hmcts_trainer import make_trainer as make_walk_trainer

        return make_walk_trainer(rounds=10_000, retrain_interval=1, save_dir=folder)
    from small_trainers import make_diayn

    sizes = {"batch_size": 16, "updates_per_batch": 1, "save_trainer_interval": 0}
    return make_diayn(folder, TOTAL, **sizes)


def live(folder: Path, report: int, frames: int = TOTAL, kind: str = "DIAYN") -> None:
    """One life of the run: continue where it stood, and report every checkpoint that is written."""
    trainer = make_trainer(folder, kind)
    if any(folder.glob("checkpoint-*")):
        trainer.load(folder)
    trainer.total_frames = frames
    if kind == "DIAYN":
        trainer.collector.total_frames = frames
    rotation, save = trainer.checkpoint_rotation, trainer.checkpoint_rotation.save

    def save_and_report(*args: Any, **kwargs: Any) -> Path:
        path = save(*args, **kwargs)
        os.write(report, b"%012d" % kwargs["step"])
        return path

    rotation.save = save_and_report
    trainer.train()


def weights(folder: Path, kind: str) -> Any:
    trainer = make_trainer(folder, kind)
    trainer.load(folder)
    state = {**trainer.loss_module.state_dict(), "frames": trainer.collected_frames}
    trainer.collector.shutdown()
    return state


def kill_again_and_again(
    folder: Path, kills: int, kind: str = "DIAYN", seed: int = 0
) -> dict[str, Any]:
    import torch

    from torchrl_hmcts.trainers.saving.checkpoints import find_damage, newest_checkpoint

    torch.set_num_threads(1)
    rng, begin = random.Random(seed), time.process_time()
    killed, torn, lost, written, last = 0, 0, 0, 0, 0
    steps: list[int] = []
    while killed < kills:
        receive, report = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(receive)
            status = 1
            try:
                live(folder, report, kind=kind)
                status = 0
            finally:
                os._exit(status)
        os.close(report)
        first = os.read(receive, 12)  # it is under way
        time.sleep(rng.uniform(0.0, 0.08))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        assert os.WIFSIGNALED(status), f"the run ended by itself with {status}"
        reports = first
        while more := os.read(receive, 4096):
            reports += more
        os.close(receive)
        killed += 1
        torn += any(folder.glob(".*writing-*"))  # while it wrote a checkpoint
        assert not [p for p in folder.glob("checkpoint-*") if find_damage(p)]
        reported = int(reports[-12:])
        newest = newest_checkpoint(folder)
        found = int(newest.stem.removeprefix("checkpoint-"))
        lost += found < reported
        assert found >= last, "the run went back"
        written += len(reports) // 12
        steps.append(last := found)
    receive, report = os.pipe()
    end = last + 2 * BATCH
    resumed, unbroken = folder, folder.with_name("unbroken")
    for place in (resumed, unbroken):
        live(place, report, end, kind)
    a, b = weights(resumed, kind), weights(unbroken, kind)
    same = a.keys() == b.keys() and all(
        torch.equal(a[k], b[k]) if isinstance(a[k], torch.Tensor) else a[k] == b[k] for k in a
    )
    return {
        "kills": killed,
        "killed_while_writing_a_checkpoint": torn,
        "checkpoints_written": written,
        "damaged_checkpoints": 0,
        "checkpoints_lost": lost,
        "base_steps": end,
        "same_bits_as_the_unbroken_run": same,
        "cpu_seconds": round(time.process_time() - begin, 1),
    }


def run_killed(tmp_path, kills: int, kind: str = "DIAYN") -> dict[str, Any]:
    words = [sys.executable, __file__, str(tmp_path / "killed"), str(kills), kind]
    done = subprocess.run(words, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


def check(result: dict[str, Any], kills: int) -> None:
    assert result["kills"] == kills
    assert result["checkpoints_lost"] == result["damaged_checkpoints"] == 0
    assert result["checkpoints_written"] >= kills
    assert result["same_bits_as_the_unbroken_run"]


@pytest.mark.parametrize("kind", ["DIAYN", "HMCTS"])
def test_a_run_killed_at_random_moments_ends_as_one_that_was_not(tmp_path, kind: str) -> None:
    check(run_killed(tmp_path, 3, kind), 3)


@pytest.mark.slow
def test_fifty_kills_lose_no_checkpoint(tmp_path) -> None:
    result = run_killed(tmp_path, 50)
    check(result, 50)
    assert result["killed_while_writing_a_checkpoint"] >= 5


if __name__ == "__main__":
    place = Path(sys.argv[1])
    place.mkdir(parents=True, exist_ok=True)
    print(json.dumps(kill_again_and_again(place, int(sys.argv[2]), *sys.argv[3:4])))
