"""A machine that lacks something: compiled code, processes and shared memory get by, or say it."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_trainers import make_networks
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from torchrl_hmcts import compiling, processes
from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.objectives import A3CLoss
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers import A3CTrainer, LearnerError
from torchrl_hmcts.trainers.a3c import learner_processes
from torchrl_hmcts.transforms import OptionTransform

linux = pytest.mark.skipif(sys.platform != "linux", reason="uses Linux's /proc and limits")
root_only = pytest.mark.skipif(
    sys.platform != "linux"
    or os.geteuid() != 0
    or shutil.which("unshare") is None
    or subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode != 0,
    reason="makes a mount namespace, which needs root on Linux",
)


def python(
    *words: str | Path, before: str | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run Python; ``before`` is what root does first, in a mount namespace of its own."""
    command = [sys.executable, *map(str, words)]
    if before is not None:
        inside = f'{before} && exec {sys.executable} "$@"'
        command = ["unshare", "-m", "bash", "-c", inside, "bash", *map(str, words)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)


# ------------------------------------------------------------------ compiled code

KERNEL = """
from torchrl_hmcts.compiling import njit
FACTOR = {factor}
@njit()
def inner(x):
    return x * FACTOR
@njit()
def kernel(x):
    return inner(x) + 1
print(kernel(3))
print(*kernel.stats.cache_hits.values())
"""


def run_kernel(path: Path, cache: Path, factor: int = 2) -> str:
    path.write_text(KERNEL.format(factor=factor))
    return python(path, NUMBA_CACHE_DIR=str(cache)).stdout


def damage(folder: Path, how: str) -> None:
    for file in folder.rglob("*.nbc"):
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes({"flipped": bytes(content), "cut": content[:100], "empty": b""}[how])


@pytest.mark.parametrize(
    "how",
    ["flipped", *(pytest.param(how, marks=pytest.mark.slow) for how in ("cut", "empty"))],
)
def test_a_damaged_file_of_compiled_code_is_compiled_again(tmp_path: Path, how: str) -> None:
    cache = tmp_path / "cache"
    assert run_kernel(tmp_path / "k.py", cache) == "7\n\n"
    assert run_kernel(tmp_path / "k.py", cache) == "7\n1\n"
    damage(cache, how)
    assert run_kernel(tmp_path / "k.py", cache) == "7\n\n"
    assert run_kernel(tmp_path / "k.py", cache) == "7\n1\n"


def test_compiled_code_follows_a_constant_that_it_holds(tmp_path: Path) -> None:
    assert run_kernel(tmp_path / "k.py", tmp_path / "cache", 2).startswith("7")
    assert run_kernel(tmp_path / "k.py", tmp_path / "cache", 5).startswith("16")


@root_only
@pytest.mark.parametrize("where", ["temporary folder", "nowhere", "full"])
def test_without_a_folder_for_compiled_code_it_is_compiled_with_one_line(
    tmp_path: Path, where: str
) -> None:
    (tmp_path / "k.py").write_text(KERNEL.format(factor=2))
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    size = "-o size=8k" if where == "full" else ""
    before = (
        f"mount --bind {tmp_path} {tmp_path} && mount -o remount,ro,bind {tmp_path} && "
        f"mount -t tmpfs {size} tmpfs {temporary}"
    )
    if where == "nowhere":
        before += f" && touch {temporary}/torchrl_hmcts-0"  # somebody else's
    variable = "NUMBA_CACHE_DIR" if where == "full" else "TMPDIR"
    environment = {"HOME": "/nonexistent", "XDG_CACHE_HOME": "/proc/nowhere"}
    done = python(tmp_path / "k.py", before=before, **{**environment, variable: str(temporary)})
    assert done.stdout == "7\n\n", done.stderr
    (line,) = done.stderr.splitlines()
    assert ("is kept in" if where == "temporary folder" else "cannot be kept in") in line
    assert "NUMBA_CACHE_DIR" in line


@linux
@pytest.mark.parametrize("made", ["by another user", "open to all", "as a link"])
def test_code_is_not_loaded_from_a_temporary_folder_that_others_can_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: str
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    compiling.private_folder.cache_clear()
    folder = compiling.private_folder()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    compiling.private_folder.cache_clear()
    if made == "open to all":
        folder.chmod(0o777)
    elif made == "as a link":
        folder.rename(tmp_path / "elsewhere")
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        other = os.geteuid() + 1
        folder.rename(folder.with_name(f"torchrl_hmcts-{other}"))
        monkeypatch.setattr("os.geteuid", lambda: other)
    with pytest.raises(OSError, match="others can write it|not a folder"):
        compiling.private_folder()
    compiling.private_folder.cache_clear()


# ------------------------------------------------------------------ threads and copies


def make_planner_env() -> Any:
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    base = WaterworldMazeEnv(maze_pool("test")[:2], seed=0)
    return TransformedEnv(base, OptionTransform(worker, num_options=4, max_steps=20))


def test_plans_in_threads_end_with_the_trees_of_plans_in_turn() -> None:
    env = make_planner_env()
    roots = [env.reset() for _ in range(4)]

    def plan(root: Any) -> np.ndarray:
        planner = MCTSPlanner(env, novelty=RadiusNovelty("position", 0.6))
        planner(root.clone())
        tree = planner.last_search.tree
        return tree.nodes[0, : int(tree.num_nodes[0])].copy()

    in_turn = [plan(root) for root in roots]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(plan, roots))
    for one, other in zip(in_turn, together, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_process_forked_while_a_thread_steps_can_step() -> None:
    env = WaterworldMazeEnv(maze_pool("test")[:1], seed=0)
    td = env.reset().set("action", torch.tensor(1))
    want = env.step(td.clone())["next", "position"]
    stop = threading.Event()

    def step() -> None:
        while not stop.is_set():
            env.step(td.clone())

    thread = threading.Thread(target=step)
    thread.start()
    try:
        for _ in range(5):
            child = os.fork()
            if child == 0:
                signal.alarm(20)  # a lock held by a thread that is not here
                os._exit(0 if env.step(td.clone())["next", "position"].equal(want) else 1)
            assert os.waitpid(child, 0)[1] == 0
    finally:
        stop.set()
        thread.join()


# ------------------------------------------------------------------ signs of life


def test_a_look_after_a_long_sleep_counts_two_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(processes.time, "monotonic", lambda: now[0])
    silence = processes.Silence()
    silence.look("a")
    now[0] += 3600.0  # stopped, or asleep
    assert silence.look("a") == 2.0
    now[0] += 0.5
    assert silence.look("a") == 2.5
    now[0] += 0.5
    assert silence.look("b") == 0.0


def stop_a_learner(trainer: A3CTrainer) -> list[int]:
    """Stop learner 1 as soon as it has taken a step, in a thread; its process id comes then."""
    pids: list[int] = []

    def wait() -> None:
        while int(trainer.shared.steps[1]) == 0:
            time.sleep(0.01)
        pids.append(trainer.learners.running[1][0].pid)
        os.kill(pids[0], signal.SIGSTOP)

    threading.Thread(target=wait, daemon=True).start()
    return pids


def make_trainer(**kwargs: Any) -> A3CTrainer:
    return A3CTrainer(
        lambda: ChainEnv(4), A3CLoss(*make_networks(4)), start_method="fork", **kwargs
    )


@linux
def test_a_stopped_learner_ends_the_run_with_its_name_and_a_checkpoint(tmp_path: Path) -> None:
    trainer = make_trainer(total_frames=10**9, save_dir=tmp_path, step_seconds=2.0)
    pids = stop_a_learner(trainer)
    with pytest.raises(LearnerError, match=r"Learner 1 of 2 .* has not answered for \d+ s"):
        trainer.train()
    assert any(tmp_path.glob("checkpoint-*"))
    assert not os.path.exists(f"/proc/{pids[0]}")


@linux
def test_a_run_that_has_reached_its_frames_ends_though_a_learner_is_stopped(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(learner_processes, "_STOP_SECONDS", 1.0)
    trainer = make_trainer(total_frames=4000)
    pids = stop_a_learner(trainer)
    history = trainer.train()
    assert history["frames"][-1] >= 4000
    assert not os.path.exists(f"/proc/{pids[0]}")
    assert "Learner 1 of 2" in capfd.readouterr().err


# ------------------------------------------------------------------ what the machine lacks
NETWORK = """
from torchrl_hmcts.envs import SharedMLP
try:
    SharedMLP(4, 4)
except Exception as error:
    print(type(error).__name__, error)
"""


@root_only
def test_too_little_shared_memory_is_named_with_its_size_and_the_fix() -> None:
    """The same for A3C, a pool and buffers: ``benchmarks/environments.py``."""
    code = f"{NETWORK}import os; print('left', os.listdir('/dev/shm'))"
    done = python("-c", code, before="mount -t tmpfs -o size=16k tmpfs /dev/shm")
    assert done.stdout.startswith("OSError"), done
    assert "/dev/shm has 16,384 bytes" in done.stdout
    assert "docker run --shm-size=" in done.stdout
    assert done.stdout.endswith("left []\n")


@linux
@pytest.mark.parametrize(
    ("error", "words"),
    [
        (BlockingIOError(errno.EAGAIN, "unavailable"), "This user may have 8 processes"),
        (EOFError("unexpected EOF"), "The process that starts the others has ended"),
    ],
    ids=["spawn", "forkserver"],
)
def test_too_few_processes_are_named_with_their_limit(
    error: Exception, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import resource

    monkeypatch.setattr(resource, "getrlimit", lambda _: (8, 8))
    with pytest.raises(OSError, match=words) as raised, processes.system_errors("it cannot start"):
        raise error
    assert "8 processes and threads (`ulimit -u`)" in str(raised.value)


@linux
@pytest.mark.parametrize(("number", "pipes"), [(24, 3), (14, 14)], ids=["pool", "a3c"])
def test_each_process_counts_two_descriptors_before_any_is_started(
    number: int, pipes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    import resource

    open_files = len(os.listdir("/proc/self/fd"))
    needed = 2 * number + pipes + 16  # to start one
    monkeypatch.setattr(resource, "getrlimit", lambda _: (open_files + needed, 4096))
    processes.need_descriptors(number, pipes)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (open_files + needed - 1, 4096))
    with pytest.raises(OSError, match=f"it needs {needed} more files, and {needed - 1} are left"):
        processes.need_descriptors(number, pipes)


@linux
@pytest.mark.parametrize("length", [10, pytest.param(90, marks=pytest.mark.slow), 200])
def test_the_forkserver_has_a_socket_for_any_temporary_folder(tmp_path: Path, length: int) -> None:
    folder = tmp_path / ("x" * (length - length // 2)) / ("y" * (length // 2))
    folder.mkdir(parents=True)
    script = tmp_path / "script.py"
    script.write_text(
        "from torchrl_hmcts.processes import start_context\n"
        "if __name__ == '__main__':\n"
        "    context = start_context('forkserver')\n"
        "    process = context.Process(target=print, args=('ran', ))\n"
        "    process.start(); process.join(); print(context.get_start_method(), process.exitcode)\n"
    )
    done = python(script, TMPDIR=str(folder))
    assert done.stdout.splitlines() == ["ran", "forkserver 0"], done.stderr
    assert not list(folder.iterdir())
