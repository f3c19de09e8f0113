"""Kills runs of every experiment at random moments and compares them with runs left alone.

    python tests/benchmarks/kills.py --kills 60            (about 12 minutes on two cores)
    python tests/benchmarks/kills.py --runs demo atari --kills 8

Experiments of the command line are started by ``hmcts`` and continued by ``hmcts train
resume=DIR`` (a sweep by its own command). They are ended by SIGKILL, by SIGTERM, or one of their
processes is stopped (SIGSTOP) and killed. DIAYN and HMCTS, which have no experiment of their own,
live in forks of one process, see ``tests/test_fault_kills.py``. Counted: kills; runs that could not
be continued; runs whose newest checkpoint went back; runs that ended with other figures.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
HMCTS = str(Path(sys.executable).with_name("hmcts"))
SECONDS = 300  # in which a life ends, or hangs
_OF_A_CLOCK = re.compile(r"second|time|date|speed|commands|per_s|machine|versions|config")


@dataclass
class Run:
    """An experiment: how it starts, its share of the kills, and whether it repeats to the bit."""

    words: list[str]
    share: int
    continued: bool = True  # by `train resume=`, else by the same words once more
    same_bits: bool = True
    children: bool = False


ATARI = (
    "train experiment=atari game=Pong source=repeat option_steps=10 frames=6000 "
    "max_episode_frames=1500 ratio=1 num_processes=2 seed=1"
)
RUNS = {
    "demo": Run("demo toy=true seed=0".split(), 9),
    "labmaze": Run("train experiment=labmaze toy=true seed=1".split(), 8),
    "a3c, one learner": Run(
        "train experiment=waterworld_a3c toy=true seed=3 num_learners=1".split(), 5, children=True
    ),
    "a3c, two learners": Run(
        "train experiment=waterworld_a3c toy=true seed=3 num_learners=2".split(),
        5,
        same_bits=False,
        children=True,
    ),
    "atari": Run(ATARI.split(), 9, children=True),
    "sweep": Run(
        "sweep experiment=waterworld_a3c toy=true num_learners=0 trials=3 lr=0.0001,0.0007".split(),
        4,
        continued=False,
        same_bits=False,
    ),
}
FORKED = {"DIAYN": 12, "HMCTS": 8}


def start(words: list[str], log: Path) -> subprocess.Popen[bytes]:
    """Start a command in a session of its own."""
    with log.open("ab") as file:
        file.write(f"\n$ hmcts {' '.join(words)}\n".encode())
        file.flush()
        return subprocess.Popen(
            [HMCTS, *words],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            start_new_session=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )


def of_session(session: int) -> list[int]:
    """Processes of a session that live, without its first."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            pid = int(path.name)
            state = (path / "stat").read_text().rpartition(")")[2].split()[0]
            if pid != session and os.getsid(pid) == session and state != "Z":
                found.append(pid)
        except (OSError, ValueError):
            continue
    return found


def newest_step(folder: Path) -> int:
    """The step of the newest checkpoint in a run's folder, -1 without one."""
    steps = [
        int(found[1])
        for path in folder.rglob("*checkpoint-*")
        if (found := re.fullmatch(r"checkpoint-(\d+)(\.\w+)?", path.name))
    ]
    return max(steps, default=-1)


def figures(folder: Path) -> dict[str, Any]:
    """What a finished run found, without what a clock measured."""
    found: dict[str, Any] = {
        "metrics": _timeless(json.loads((folder / "metrics.json").read_text()))
    }
    if (folder / "curves.csv").exists():
        with (folder / "curves.csv").open() as file:
            found["curves"] = [row for row in csv.reader(file) if not _OF_A_CLOCK.search(row[0])]
    return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _timeless(v) for k, v in value.items() if not _OF_A_CLOCK.search(k)}
    return [_timeless(item) for item in value] if isinstance(value, list) else value


def end(process: subprocess.Popen[bytes], how: str, rng: random.Random) -> bool:
    """End a run in one of three ways; return whether it was still running."""
    if process.poll() is not None:
        return False
    children = of_session(process.pid)
    if how == "child" and children:
        child = rng.choice(children)
        os.kill(child, signal.SIGSTOP)
        time.sleep(0.5)
        os.kill(child, signal.SIGKILL)
    else:
        process.send_signal(signal.SIGKILL if how == "child" else signal.Signals[how])
    return True


def kill_run(run: Run, kills: int, folder: Path, rng: random.Random) -> dict[str, Any]:
    """Kill one experiment so many times, let it end, and compare it with one left alone."""
    alone, place, log = folder / "alone", folder / "killed", folder / "log.txt"
    begin = time.monotonic()
    process = start([*run.words, f"out={alone}"], log)
    if process.wait(SECONDS):
        raise RuntimeError(log.read_text()[-2000:])
    whole = time.monotonic() - begin
    counts = dict.fromkeys(("SIGKILL", "SIGTERM", "child"), 0)
    result: dict[str, Any] = {"kills": 0, "not_continued": 0, "went_back": 0, "lives": 0}
    result["processes_left"] = 0
    again, step = False, -1
    while True:
        words = [*run.words, f"out={place}"]
        if again and run.continued and (place / "run.json").exists():
            words = ["train", f"resume={place}"]
        process = start(words, log)
        result["lives"] += 1
        how = ""
        begin = time.monotonic()
        if result["kills"] < kills:
            how = rng.choice(["SIGKILL", "SIGKILL", "SIGTERM", *["child"] * run.children])
            first = result["kills"] == 0  # the imports are most of a life
            moment = whole * rng.uniform(0.5 if first else 0.3, 0.9)
            while process.poll() is None and time.monotonic() - begin < moment:
                time.sleep(0.02)
            if end(process, how, rng):
                result["kills"] += 1
                counts[how] += 1
        status = process.wait(SECONDS)
        time.sleep(5.0 if how == "SIGKILL" else 0.0)  # its processes notice
        left = of_session(process.pid)
        result["processes_left"] += len(left)
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        found = newest_step(place)
        result["went_back"] += found < step
        step = max(step, found)
        again = True
        if status == 0:
            if result["kills"] >= kills:
                break
            again, step = False, -1  # it was finished first: once more from its beginning
            subprocess.run(["rm", "-rf", str(place)], check=True)
        elif status in (1, 2) and "There is no checkpoint" in log.read_text()[-2000:]:
            again = False  # killed before its first checkpoint
            subprocess.run(["rm", "-rf", str(place)], check=True)
        elif status in (1, 2) and result["lives"] > 3 * kills + 5:
            result["not_continued"] += 1
            result["says"] = log.read_text()[-600:]
            break
    result.update({f"by_{how}": number for how, number in counts.items()})
    if not result["not_continued"] and run.same_bits:
        result["same_figures"] = figures(place) == figures(alone)
    return result


def kill_forks(kind: str, kills: int, folder: Path) -> dict[str, Any]:
    """Kill a trainer in forks of one process."""
    script = str(ROOT / "tests" / "test_fault_kills.py")
    words = [sys.executable, script, str(folder / kind), str(kills), kind]
    done = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def kill_all(kills: int, names: list[str] | None = None, seed: int = 0) -> dict[str, Any]:
    """Share the kills out among the experiments; return the counts of each, and of all."""
    names = names or [*FORKED, *RUNS]
    shares = {name: FORKED[name] if name in FORKED else RUNS[name].share for name in names}
    total, rng, found = sum(shares.values()), random.Random(seed), {}
    left = kills
    for i, name in enumerate(names):
        number = left if i == len(names) - 1 else max(1, round(kills * shares[name] / total))
        left -= number
        with tempfile.TemporaryDirectory() as folder:
            if name in FORKED:
                found[name] = kill_forks(name, number, Path(folder))
            else:
                found[name] = kill_run(RUNS[name], number, Path(folder), rng)
        print(name, found[name], file=sys.stderr, flush=True)
    rows = list(found.values())
    return {
        "kills": sum(row["kills"] for row in rows),
        "lost": sum(
            row.get("not_continued", 0) + row.get("went_back", 0) + row.get("checkpoints_lost", 0)
            for row in rows
        ),
        "damaged_checkpoints": sum(row.get("damaged_checkpoints", 0) for row in rows),
        "same_bits": all(
            row.get("same_figures", row.get("same_bits_as_the_unbroken_run", True)) for row in rows
        ),
        "runs": found,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--runs", nargs="*", choices=[*FORKED, *RUNS])
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print(json.dumps(kill_all(arguments.kills, arguments.runs, arguments.seed)))
