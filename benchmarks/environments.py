"""What works, and what is said, on machines that lack something; writes a table for docs/results.

    python benchmarks/environments.py             (about 10 minutes on two cores)
    python benchmarks/environments.py --only "no home folder" --actions import plan

Each situation is made in a mount namespace (``unshare -m``, which needs root on Linux), so nothing
outside it changes; elsewhere, the situations that need one are skipped with the reason. In each,
what it may concern of five things is tried in a new process: to import, to plan, ``hmcts demo
toy=true``, a small A3C and a small Atari pool. What counts: it works, or an error says why within
its time; nothing is left in /dev/shm, and no process.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sessions import living

ROOT = Path(__file__).resolve().parents[1]
HMCTS = Path(sys.executable).with_name("hmcts")
SECONDS = 120  # for an action, imports and compilation included

CODE = {
    "import": """
import torchrl_hmcts.envs, torchrl_hmcts.planners, torchrl_hmcts.trainers
""",
    "plan": """
from torchrl_hmcts.planners import MCTSPlanner
from torchrl_hmcts.testing import ChainEnv
env = ChainEnv(5)
assert int(MCTSPlanner(env)(env.reset())["action"]) == 1
""",
    "a3c": """
import os, torch
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl_hmcts.objectives import A3CLoss
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers import A3CTrainer
def make_env():
    return ChainEnv(4)
if __name__ == "__main__":
    actor = ProbabilisticActor(
        TensorDictModule(torch.nn.Embedding(4, 2), ["state"], ["logits"]), in_keys=["logits"],
        distribution_class=torch.distributions.Categorical)
    loss = A3CLoss(actor, ValueOperator(torch.nn.Embedding(4, 1), in_keys=["state"]))
    learners = int(os.environ.get("PROCESSES", 2))
    trainer = A3CTrainer(make_env, loss, total_frames=400, num_learners=learners)
    assert trainer.train()["frames"][-1] >= 400
""",
    "pool": """
import os
from torchrl_hmcts.envs import AtariOptionPool, RepeatActions
if __name__ == "__main__":
    processes = int(os.environ.get("PROCESSES", 2))
    pool = AtariOptionPool("Pong", RepeatActions(2), max_steps=3, num_processes=processes, seed=0)
    assert pool.rollout(2)["next", "duration"].flatten().tolist() == [3, 3]
    pool.close()
""",
}
ACTIONS = ["import", "plan", "demo", "a3c", "pool"]


@dataclass
class Situation:
    """A machine: shell commands that make it of this one, and its environment.

    ``{place}`` is an empty folder, ``{home}`` and ``{packages}`` those of this machine.
    """

    what: str
    before: str = "true"
    environment: dict[str, str] = field(default_factory=dict)
    out: str = "{place}/run"
    in_front: str = ""  # of the command
    needs: str = ""  # a program
    actions: str = "plan demo a3c pool"  # that it may concern

    def lacking(self) -> str:
        if "mount" in self.before and not _can_mount():
            return "needs root on Linux, for a mount namespace"
        if self.needs and shutil.which(self.needs) is None:
            return f"needs the program {self.needs}"
        return ""


def _can_mount() -> bool:
    if sys.platform != "linux" or os.geteuid() != 0 or shutil.which("unshare") is None:
        return False
    return subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode == 0


def _read_only() -> str:
    """Commands that put copies of the package without compiled code in place, read-only."""
    lines = []
    for i, name in enumerate(("torchrl_hmcts", "envs", "trainers")):
        copy = f"{{place}}/{i}"
        lines += [
            f"cp -r {shlex.quote(str(ROOT / name))} {copy}",
            f"find {copy} -name '*.nb[ic]' -delete",
            f"mount --bind {copy} {shlex.quote(str(ROOT / name))}",
            f"mount -o remount,ro,bind {shlex.quote(str(ROOT / name))}",
        ]
    return " && ".join(lines)


_NO_HOME = {"HOME": "/nonexistent", "XDG_CACHE_HOME": "/proc/nowhere"}
_LONG = "{place}/" + "x" * 100 + "/" + "y" * 100
SITUATIONS = [
    Situation("as it is", actions="import plan demo a3c pool"),
    Situation("read-only installation", _read_only(), actions="import plan"),
    Situation("no home folder", environment=_NO_HOME, actions="import plan"),
    Situation("read-only installation, no home folder", _read_only(), _NO_HOME),
    Situation(
        "the same, and TMPDIR that cannot be written",
        _read_only() + " && mkdir {place}/t && mount -t tmpfs -o ro tmpfs {place}/t",
        {**_NO_HOME, "TMPDIR": "{place}/t"},
        actions="plan a3c pool",
    ),
    Situation("/dev/shm of 16 kB", "mount -t tmpfs -o size=16k tmpfs /dev/shm"),
    Situation("/dev/shm of 1 MB", "mount -t tmpfs -o size=1m tmpfs /dev/shm"),
    Situation("64 file descriptors", "ulimit -n 64"),
    Situation(
        "64 file descriptors, 24 processes wanted",
        "ulimit -n 64",
        {"PROCESSES": "24"},
        actions="a3c pool",
    ),
    Situation("32 file descriptors", "ulimit -n 32"),
    Situation(
        "full disk (2 MB) for the run",
        "mkdir {place}/small && mount -t tmpfs -o size=2m tmpfs {place}/small",
        out="{place}/small/run",
        actions="demo",
    ),
    Situation(
        "full disk (8 kB) for compiled code",
        "mkdir {place}/small && mount -t tmpfs -o size=8k tmpfs {place}/small",
        {"NUMBA_CACHE_DIR": "{place}/small"},
        actions="plan",
    ),
    Situation(
        "full TMPDIR (4 kB)",
        "mkdir {place}/small && mount -t tmpfs -o size=4k tmpfs {place}/small"
        " && (head -c 4096 /dev/zero > {place}/small/full; true)",
        {"TMPDIR": "{place}/small"},
    ),
    Situation("TMPDIR that is missing", environment={"TMPDIR": "{place}/missing"}),
    Situation("TMPDIR of 200 characters", f"mkdir -p {_LONG}", {"TMPDIR": _LONG}),
    Situation("out= of 200 characters", out=_LONG + "/run", actions="demo"),
    Situation("out= with other letters", out="{place}/läufe 走る/#1", actions="demo"),
    Situation("LC_ALL=C", environment={"LC_ALL": "C", "PYTHONUTF8": "0"}, actions="demo pool"),
    Situation(
        "Latin-1 output",
        environment={"PYTHONIOENCODING": "latin-1", "LANG": "C"},
        out="{place}/走る",
        actions="demo",
    ),
    Situation(
        "clock of the year 2001",
        environment={"DONT_FAKE_MONOTONIC": "1"},
        in_front="faketime '2001-01-01'",
        needs="faketime",
    ),
    Situation(
        "another user, who may have 8 processes",
        in_front="setpriv --reuid=65534 --inh-caps=+dac_read_search --ambient-caps=+dac_read_search"
        " prlimit --nproc=8",
        actions="a3c pool",
        environment={"PROCESSES": "8", "HOME": "{place}"},
        needs="setpriv",
    ),
    Situation("8 GB of address space", "ulimit -v 8000000"),
]


def attempt(situation: Situation, action: str) -> dict[str, Any]:
    """Try one thing in one situation; return what happened."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        os.chmod(folder, 0o777)
        place = Path(folder)

        def filled(text: str) -> str:
            return text.replace("{place}", folder)

        if action == "demo":
            out = filled(situation.out)
            words = [str(HMCTS), "demo", "toy=true", "seed=0", f"out={json.dumps(out)}"]
            if out.isascii() and "#" not in out:
                words[-1] = f"out={out}"
        else:
            script = place / f"{action}.py"
            script.write_text(CODE[action])
            words = [sys.executable, str(script)]
        command = f"{situation.in_front} {shlex.join(words)}; status=$?"
        line = f"{filled(situation.before)} && {{ {command}; }}; exit $status"
        shell = ["bash", "-c", line]
        if _can_mount():  # with shared memory of its own, to see what is left there
            count = f"ls /dev/shm | wc -l > {folder}/left; exit $status"
            line = f"{filled(situation.before)} && {{ {command}; {count}; }}; exit 1"
            own = "true" if "/dev/shm" in line.split("ls ")[0] else "mount -t tmpfs shm /dev/shm"
            shell = ["unshare", "-m", "bash", "-c", f"{own} && {line}"]
        given = {k: filled(v) for k, v in situation.environment.items()}
        environment = {**os.environ, "OMP_NUM_THREADS": "1", **given}
        begin = time.monotonic()
        process = subprocess.Popen(
            shell,
            cwd=folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        try:
            said, _ = process.communicate(timeout=SECONDS)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            said, _ = process.communicate()
            return {"result": "hangs", "says": _last(said), "seconds": SECONDS}
        seconds = time.monotonic() - begin
        time.sleep(1.0)
        left = living(process.pid)
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        result = "works" if process.returncode == 0 else f"status {process.returncode}"
        found: dict[str, Any] = {"result": result, "seconds": round(seconds, 1)}
        lines = [x for x in said.splitlines() if x.startswith("torchrl_hmcts:")]
        if process.returncode or lines:
            found["says"] = _last(said) if process.returncode else lines[0]
            found["says"] = found["says"].replace(folder, "PLACE").replace(str(ROOT), "ROOT")
            own = f"{tempfile.gettempdir()}/torchrl_hmcts-{os.getuid()}"
            found["says"] = found["says"].replace(own, "TEMPORARY/torchrl_hmcts-UID")
        if left:
            found["processes_left"] = len(left)
        if (place / "left").exists() and (more := int((place / "left").read_text() or 0)):
            found["shared_memory_left"] = more
        return found


def _last(said: str) -> str:
    return (said.strip().splitlines() or [""])[-1][:400]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", help="situations, by name; the others stay")
    parser.add_argument("--actions", nargs="*", default=ACTIONS, choices=ACTIONS)
    parser.add_argument(
        "--out",
        type=Path,
        default=ROOT / "docs" / "results" / "reliability" / "environments.json",
    )
    arguments = parser.parse_args()
    begin = time.time()
    chosen = [s for s in SITUATIONS if not arguments.only or s.what in arguments.only]
    tried = [
        (situation, action)
        for situation in chosen
        for action in arguments.actions
        if action in situation.actions.split() and not situation.lacking()
    ]

    def one(pair: tuple[Situation, str]) -> dict[str, Any]:
        found = attempt(*pair)
        print(pair[0].what, "|", pair[1], "|", found, flush=True)
        return found

    situations: dict[str, Any] = {
        s.what: {"skipped": s.lacking()} if s.lacking() else {} for s in chosen
    }
    if arguments.only and arguments.out.exists():
        situations = {**json.loads(arguments.out.read_text())["situations"], **situations}
    with ThreadPoolExecutor(2) as pool:
        for (situation, action), found in zip(tried, pool.map(one, tried), strict=True):
            situations[situation.what][action] = found
    seconds = round(time.time() - begin, 1)
    if arguments.only and arguments.out.exists():
        seconds = json.loads(arguments.out.read_text())["wall_seconds"]
    record = {
        "command": "python benchmarks/environments.py",
        "python": platform.python_version(),
        "wall_seconds": seconds,
        "situations": situations,
    }
    arguments.out.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
