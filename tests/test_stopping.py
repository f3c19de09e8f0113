"""Ctrl-C and SIGTERM at any moment: training stops where it can continue from, and is saved."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from small_trainers import make_a3c, make_diayn
from torchrl.data import LazyMemmapStorage

from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.saving import resume, stopping
from torchrl_hmcts.trainers.saving.checkpoints import DurableRotation
from torchrl_hmcts.trainers.saving.locking import FolderInUse, folder_locked
from torchrl_hmcts.trainers.saving.run_folder import read_run
from torchrl_hmcts.trainers.saving.stopping import Stopped


def send(signum: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), signum)
    time.sleep(0.01)  # Python handles it here


def steps(folder: Path) -> list[int]:
    return sorted(int(re.sub(r"\D", "", p.stem)) for p in folder.glob("checkpoint-*"))


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_training_stops_after_its_batch_and_continues_as_if_it_had_not(
    tmp_path, signum: int
) -> None:
    whole = make_diayn(tmp_path / "whole", 96)
    whole.train()
    stopped = make_diayn(tmp_path / "stopped", 96)

    def stop(batch: Any) -> None:
        if stopped.collected_frames == 48:
            send(signum)  # in the middle of the batch; once more at once, as people do
            send(signum)

    stopped.register_op("pre_steps_log", stop)
    with pytest.raises(Stopped) as error:
        stopped.train()
    assert error.value.status == 128 + signum
    assert steps(tmp_path / "stopped") == [48]
    again = make_diayn(tmp_path / "stopped", 96).load(tmp_path / "stopped")
    again.train()
    assert again.history == whole.history
    for name, value in whole.loss_module.state_dict().items():
        assert torch.equal(again.loss_module.state_dict()[name], value), name
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("make", [make_diayn, make_a3c])
def test_a_second_signal_does_not_break_the_writing_of_a_checkpoint(
    tmp_path, make: Callable[[Path], Any], monkeypatch, capfd: Any
) -> None:
    save = DurableRotation.save

    def slowly(*args: Any, **kwargs: Any) -> Path:
        for _ in range(3):
            send()
            time.sleep(0.05)
        return save(*args, **kwargs)

    monkeypatch.setattr(DurableRotation, "save", slowly)
    monkeypatch.setattr(resume, "FIRST_SAVE_SECONDS", 0.0)  # the first signal comes as it saves
    monkeypatch.setattr("torchrl_hmcts.trainers.a3c.trainer.FIRST_SAVE_SECONDS", 0.0)
    trainer = make(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    (at,) = steps(tmp_path)
    assert at > 0
    make(tmp_path).load(tmp_path)  # whole
    assert capfd.readouterr().err.count("saving, one moment") == 1


def test_a_signal_in_the_middle_of_a_log_leaves_curves_of_one_length(tmp_path) -> None:
    trainer = make_a3c(tmp_path, log_interval=40)
    log = trainer.log.log

    def interrupted(lr: float) -> dict[str, float]:
        send()
        return log(lr)

    trainer.log.log = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    history = make_a3c(tmp_path, log_interval=40).load(tmp_path).history
    assert {len(values) for values in history.values()} == {1}


def test_a_patient_training_is_stopped_at_once_by_a_second_ctrl_c_a_while_later(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(stopping, "_IMPATIENT_SECONDS", 0.0)
    trainer = make_diayn(tmp_path)
    done: list[int] = []

    def stuck(batch: Any) -> None:
        send()
        send()
        done.append(trainer.collected_frames)

    trainer.register_op("pre_steps_log", stuck)
    with pytest.raises(Stopped):
        trainer.train()
    assert not done


def test_the_first_checkpoint_comes_early_and_the_next_ones_by_time(tmp_path, monkeypatch) -> None:
    now = [100.0]
    monkeypatch.setattr(resume.time, "monotonic", lambda: now[0])
    trainer = make_diayn(tmp_path, 160)
    seen: list[list[int]] = []

    def look(batch: Any) -> None:
        seen.append(steps(tmp_path))
        now[0] += 4.0 if len(seen) < 4 else 40.0

    trainer.register_op("post_steps_log", look)
    trainer.train()
    # By hand: 5 s have passed at the second batch, a minute since then at the fifth and so on.
    assert seen == [[], [], [32], [32], [32], [32, 80], [32, 80], [80, 112], [80, 112], [112, 144]]


def test_two_trainers_with_one_folder_of_checkpoints_are_refused(tmp_path) -> None:
    for make in (make_diayn, make_a3c):
        with folder_locked(tmp_path), pytest.raises(FolderInUse):
            make(tmp_path).train()
    make_diayn(tmp_path).train()


def test_a_forked_process_does_not_inherit_the_handlers() -> None:
    with stopping.signals_handled():
        child = os.fork()
        if child == 0:
            os.kill(os.getpid(), signal.SIGTERM)  # as Process.terminate() does
            os._exit(0)
        _, status = os.waitpid(child, 0)
    assert os.WTERMSIG(status) == signal.SIGTERM


def test_handlers_of_the_program_stay_and_an_ignored_signal_stays_ignored() -> None:
    seen: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda signum, frame: seen.append(signum))
    ignored = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as nohup's children have it
    try:
        with stopping.patient():
            send(signal.SIGTERM)
            send(signal.SIGINT)
            assert not stopping.stop_asked()
    finally:
        signal.signal(signal.SIGTERM, before)
        signal.signal(signal.SIGINT, ignored)
    assert seen == [signal.SIGTERM]


def test_a_memory_mapped_buffer_of_torchrl_does_not_keep_a_run_from_being_saved() -> None:
    before = [signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)]
    try:
        storage = LazyMemmapStorage(1)
        theirs = signal.getsignal(signal.SIGINT)
        with pytest.raises(Stopped), stopping.patient():
            send()
        assert signal.getsignal(signal.SIGINT) is theirs
        storage.cleanup()
    finally:
        for signum, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
            signal.signal(signum, handler)


@pytest.mark.parametrize(("signum", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_is_recorded_and_says_how_to_continue(
    tmp_path, monkeypatch, capsys, signum: int, status: int
) -> None:
    monkeypatch.setattr(
        "torchrl_hmcts.trainers.experiments.skills.run_skills", lambda config: send(signum)
    )
    assert main(["demo", f"out={tmp_path}/run"]) == status
    assert read_run(tmp_path / "run").status == "stopped"
    assert f"Continue with: hmcts train resume={tmp_path}/run" in capsys.readouterr().err


def test_a_process_that_the_same_signal_ended_makes_no_failed_run(tmp_path, monkeypatch) -> None:
    def killed(config: Any) -> None:
        with stopping.patient():
            send()
            raise RuntimeError("a process was killed by SIGINT")

    monkeypatch.setattr("torchrl_hmcts.trainers.experiments.skills.run_skills", killed)
    assert main(["demo", f"out={tmp_path}/run"]) == 130
    assert read_run(tmp_path / "run").status == "stopped"


# ---------------------------------------------------------------- whole commands


def hmcts(*words: str, until: str = "", signum: int = 0, folder: Path | None = None) -> str:
    """Runs a command; sends a signal, twice, when the file ``until`` is there. Returns stderr."""
    with subprocess.Popen(
        [sys.executable, "-m", "torchrl_hmcts.trainers.cli", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        while folder is not None and not any(folder.glob(until)):
            assert process.poll() is None
            time.sleep(0.02)
        if folder is not None:
            process.send_signal(signum)
            time.sleep(0.05)
            process.send_signal(signum)
        assert process.stderr is not None
        return process.stderr.read()


LABMAZE = "train experiment=labmaze robust_mazes=2"
WITHOUT_TIMES = re.compile(r"second|versions|checkpoint")


def figures(folder: Path) -> dict[str, Any]:
    metrics = json.loads((folder / "metrics.json").read_text())
    config = {k: v for k, v in metrics["config"].items() if k not in ("out", "resume")}
    kept = {k: v for k, v in metrics.items() if not WITHOUT_TIMES.search(k)}
    for part in (v for v in kept.values() if isinstance(v, dict)):
        for name in [name for name in part if WITHOUT_TIMES.search(name)]:
            del part[name]
    return {**kept, "config": config}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "until", "signum"),
    [
        ("demo train_base_steps=19968 mazes=20", "checkpoints/c*", signal.SIGINT),
        ("demo train_base_steps=19968 mazes=20", "run.json", signal.SIGTERM),
        (f"{LABMAZE} train_frames=20000 mazes=20", "checkpoints/c*", signal.SIGINT),
        (f"{LABMAZE} train_frames=8000 mazes=20", "run.json", signal.SIGTERM),
        (f"{LABMAZE} algorithm=hmcts train_frames=20000 mazes=5", "checkpoints/c*", signal.SIGINT),
    ],
)
def test_the_printed_command_continues_to_the_figures_of_a_run_that_was_not_stopped(
    tmp_path, words: str, until: str, signum: int
) -> None:
    stopped, whole = tmp_path / "my run", tmp_path / "whole"
    said = hmcts(*words.split(), f"out={stopped}", until=until, signum=signum, folder=stopped)
    (command,) = re.findall("Continue with: (hmcts .*)", said)
    assert hmcts(*shlex.split(command)[1:]).count("Traceback") == 0
    hmcts(*words.split(), f"out={whole}")
    assert figures(stopped) == figures(whole)
    assert read_run(stopped).status == "finished"
