"""Kills runs of every experiment at random moments and compares them with runs left alone.

    python benchmarks/kills.py --kills 60             (about 12 minutes on two cores)
    python benchmarks/kills.py --runs demo atari --kills 8

Experiments of the command line are started by their words and continued by ``hmcts train
resume=DIR`` (a sweep by its own words), with a checkpoint every second instead of every minute.
They are ended by SIGKILL or SIGTERM, or one of their processes is stopped (SIGSTOP) and killed.
DIAYN and HMCTS by themselves live in forks of one process, see ``tests/test_fault_kills.py``.
A run that ended before its kill does not count as killed: it is compared, and begun again.

Lost is: a run that could not be continued, one whose newest checkpoint went back or is damaged.
Compared with the run left alone are the figures that are no times, the curves, and every array of
the worker and of the last checkpoint. Several learners are asynchronous: of them, the curve must
have every step once, up to the last.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import itertools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sessions import living

ROOT = Path(__file__).resolve().parents[1]
HMCTS = """
import random, sys, torch
import numpy
for seed in (random.seed, numpy.random.seed, torch.manual_seed):
    seed(0)  # saved, though nothing that counts is drawn from them
from torchrl_hmcts.trainers.a3c import trainer as a3c
from torchrl_hmcts.trainers.saving import resume
for module in (a3c, resume):
    module.FIRST_SAVE_SECONDS, module.SAVE_SECONDS = 0.3, 1.0
from torchrl_hmcts.trainers.cli import main
sys.exit(main(sys.argv[1:]))
"""
SECONDS = 240  # in which a life ends, or hangs
_CHECKPOINT = re.compile(r"checkpoint-(\d+)\.\w+")
# How many frames were emulated, not how many an episode had.
_EMULATED = re.compile(r"^(frames|base_steps|frames_per_decision)$")
_OF_A_CLOCK = re.compile(r"second|time|date|speed|commands|per_s|machine|versions|config|cpu")


@dataclass
class Run:
    """An experiment: how it starts, its share of the kills, and what is promised of it."""

    words: str
    share: int
    continued: bool = True  # by `train resume=`, else by the same words once more
    same_bits: bool = True
    children: bool = False


LABMAZE = "experiment=labmaze mazes=4 curve_mazes=2 curve_points=4 robust_mazes=2 expansions=60"
A3C = (
    "train experiment=waterworld_a3c total_frames=120000 hidden=16 test_mazes=3 eval_mazes=2 "
    "eval_interval=50000 max_episode_steps=200 seed=3"
)
RUNS = {
    "demo": Run("demo train_base_steps=24000 mazes=5 seed=0", 7),
    "labmaze": Run(f"train {LABMAZE} train_frames=40000 seed=1", 7),
    "labmaze, Algorithm 3": Run(f"train {LABMAZE} algorithm=hmcts train_frames=20000 seed=1", 5),
    "A3C, a learner": Run(f"{A3C} num_learners=1", 4, same_bits=False, children=True),
    "A3C, two learners": Run(f"{A3C} num_learners=2", 5, same_bits=False, children=True),
    "Atari, a pool of two": Run(
        "train experiment=atari game=Pong source=repeat option_steps=10 frames=250000 "
        "max_episode_frames=1500 ratio=4 replant_every=10 num_processes=2 seed=1",
        8,
        children=True,
    ),
    "sweep": Run(f"sweep {LABMAZE} train_frames=8000 seed=1 trials=3 num_skills=[3,4]", 4, False),
}
FORKED = {"DIAYN": 12, "HMCTS": 8}


class Life:
    """A process of a run and what it says, in a session of its own."""

    def __init__(self, words: str, log: Path) -> None:
        with log.open("ab") as file:
            self._before = file.tell()
            file.write(f"\n$ hmcts {words}\n".encode())
            file.flush()
            self.process = subprocess.Popen(
                [sys.executable, "-c", HMCTS, *words.split()],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )
        self._log = log

    @property
    def over(self) -> bool:
        return self.process.poll() is not None

    @property
    def said(self) -> str:
        return self._log.read_bytes()[self._before :].decode(errors="replace")

    def children(self) -> list[int]:
        """Processes of the session that live, without its first."""
        return [pid for pid in living(self.process.pid) if pid != self.process.pid]

    def wait(self) -> int:
        """Wait for its end, and some seconds for that of its processes."""
        try:
            status = self.process.wait(SECONDS)
        except subprocess.TimeoutExpired:
            status = 1000  # it hangs
        deadline = time.monotonic() + 20.0
        while self.children() and time.monotonic() < deadline:
            time.sleep(0.1)
        self.left = self.children()
        for pid in self.left:
            with contextlib.suppress(OSError):
                words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[-2][:200]
                stat = Path(f"/proc/{pid}/stat").read_text().split()
                print(f"left: {words!r} {stat[2]} after {stat[13]} ticks", file=sys.stderr)
        for pid in [self.process.pid] * (status == 1000) + self.left:
            os.kill(pid, signal.SIGKILL)
        return status


def newest_step(folder: Path) -> int:
    """The step of the newest checkpoint in a run's folder, of all runs of a sweep; -1 without."""
    newest = []
    for place in (folder, *folder.glob("trial_*")):
        with contextlib.suppress(FileNotFoundError):
            names = os.listdir(place / "checkpoints")
            steps = [int(m[1]) for name in names if (m := _CHECKPOINT.fullmatch(name))]
            newest.append(max(steps, default=-1))
    return sum(step for step in newest if step >= 0) if max(newest, default=-1) >= 0 else -1


def compared(folder: Path, run: Run) -> dict[str, Any]:
    """What a finished run found, without what a clock measured."""
    if not run.continued:
        trials = [path.parent for path in folder.glob("trial_*/metrics.json")]
        return {"number of trials": len(trials), **dict(_trial(path) for path in trials)}
    metrics = json.loads((folder / "metrics.json").read_text())
    found: dict[str, Any] = {"metrics": without(_OF_A_CLOCK, metrics)}
    with contextlib.suppress(FileNotFoundError), (folder / "curves.csv").open() as file:
        found["curves"] = [row for row in csv.reader(file) if not _OF_A_CLOCK.search(row[0])]
    for kind in ("worker/worker-*", "checkpoints/checkpoint-*"):
        newest = max(folder.glob(kind), default=None)
        if newest is not None:
            found[f"name of {kind}"] = newest.name
            with zipfile.ZipFile(newest) as file:
                for entry in file.infolist():
                    if entry.filename.endswith(".memmap"):
                        found[f"{kind} {entry.filename}"] = entry.CRC
    return found


def _trial(folder: Path) -> tuple[str, Any]:
    """The varied value of a trial, and its figures."""
    metrics = json.loads((folder / "metrics.json").read_text())
    return str(metrics["config"]["num_skills"]), without(_OF_A_CLOCK, metrics)


def without(pattern: re.Pattern[str], value: Any) -> Any:
    """Leave out the entries whose names a pattern finds."""
    if isinstance(value, dict):
        return {k: without(pattern, v) for k, v in value.items() if not pattern.search(k)}
    return [without(pattern, item) for item in value] if isinstance(value, list) else value


def curve_is_whole(folder: Path) -> bool:
    """Whether the curve of a run of A3C has its steps once each, in order, up to the last."""
    with (folder / "curves.csv").open() as file:
        steps = [float(row["value"]) for row in csv.DictReader(file) if row["name"] == "frames"]
    last = json.loads((folder / "metrics.json").read_text())["train_base_steps"]
    return steps == sorted(set(steps)) and steps[-1] == last


class Victim:
    """One experiment that is killed again and again, and compared with one left alone."""

    def __init__(self, name: str, kills: int, folder: Path, seed: int) -> None:
        self.run, self.wanted, self.folder = RUNS[name], kills, folder
        self.rng = random.Random(seed)
        ways = ["SIGKILL", "SIGTERM", *["child"] * self.run.children]
        self.rng.shuffle(ways)
        self.ways = itertools.cycle(ways)
        self.log = folder / "log.txt"
        self.result: dict[str, Any] = dict.fromkeys(
            ("kills", "by_SIGKILL", "by_SIGTERM", "by_child", "lives", "finished"), 0
        )
        self.result |= dict.fromkeys(("not_continued", "went_back", "damaged", "hung"), 0)
        self.result |= {"killed_before_a_checkpoint": 0, "processes_left": 0, "differs": []}

    def live(self) -> dict[str, Any]:
        alone = self.folder / "alone"
        if Life(f"{self.run.words} out={alone}", self.log).wait():
            raise RuntimeError(self.log.read_text()[-2000:])
        whole, number = compared(alone, self.run), 0
        while True:
            number += 1
            place = self.folder / f"killed{number}"
            if not self.until_finished(place):
                self.result["not_continued"] += 1
            else:
                self.compare(place, whole)
            if self.result["kills"] >= self.wanted or self.result["not_continued"]:
                break
            shutil.rmtree(place)
        self.result["same_figures"] = not self.result["differs"] if self.run.same_bits else None
        return self.result

    def compare(self, place: Path, whole: dict[str, Any]) -> None:
        self.result["finished"] += 1
        if not self.run.same_bits:
            if not curve_is_whole(place):
                self.result["went_back"] += 1
            return
        mine = compared(place, self.run)
        names = whole.keys() | mine.keys()
        if not self.run.continued:  # other trials follow a killed one: compare those in both
            names = whole.keys() & mine.keys()
        if self.result["by_child"]:  # what a killed emulator had emulated is counted, and repeated
            names -= {"curves", "name of checkpoints/checkpoint-*"}
            whole, mine = without(_EMULATED, whole), without(_EMULATED, mine)
        differs = sorted(name for name in names if whole.get(name) != mine.get(name))
        self.result["differs"] = sorted({*self.result["differs"], *differs})

    def until_finished(self, place: Path) -> bool:
        """Begin a run, kill and continue it until it has finished; return whether it has."""
        step, failures = -1, 0
        while failures < 2:
            known = self.run.continued and (place / "run.json").exists()
            words = f"train resume={place}" if known else f"{self.run.words} out={place}"
            life = Life(words, self.log)
            self.result["lives"] += 1
            killed = self.kill(life, place, step)
            status = life.wait()
            self.result["processes_left"] += len(life.left)
            if status == 1000:
                self.result["hung"] += 1
                return False
            found = newest_step(place)
            self.result["went_back"] += found < step
            self.result["killed_before_a_checkpoint"] += found < 0 and killed
            self.result["damaged"] += "damaged" in life.said
            step = max(step, found)
            if status == 0:
                return True
            failures = 0 if killed else failures + 1
            if not killed:
                self.result["says"] = life.said[-1500:]
        return False

    def kill(self, life: Life, place: Path, step: int) -> bool:
        """Kill a life at a random moment, perhaps several of its processes; return whether."""
        killed = False
        while self.result["kills"] < self.wanted:
            if self.rng.random() < 0.25:  # anywhere, the imports included
                until = time.monotonic() + self.rng.uniform(1.0, 12.0)
            else:
                while not life.over and newest_step(place) <= step:
                    time.sleep(0.02)
                until = time.monotonic() + self.rng.uniform(0.0, 1.5)
            while not life.over and time.monotonic() < until:
                time.sleep(0.01)
            how = next(self.ways)
            children = life.children()
            if life.over:
                return killed
            if how == "child" and children:
                child = self.rng.choice(children)
                try:
                    os.kill(child, signal.SIGSTOP)
                    time.sleep(0.5)
                    os.kill(child, signal.SIGKILL)
                except ProcessLookupError:  # it was over by itself
                    continue
            else:
                how = "SIGKILL" if how == "child" else how
                life.process.send_signal(signal.Signals[how])
            self.result["kills"] += 1
            self.result[f"by_{how}"] += 1
            killed = True
            if how != "child":
                return True
            with contextlib.suppress(subprocess.TimeoutExpired):  # a pool replaces its process
                life.process.wait(4.0)
                return True
            step = newest_step(place)
        return killed


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
    total = sum(shares.values())
    ends = [round(kills * sum(list(shares.values())[:i]) / total) for i in range(len(shares) + 1)]
    numbers = {name: ends[i + 1] - ends[i] for i, name in enumerate(names)}

    def one(name: str) -> dict[str, Any]:
        with tempfile.TemporaryDirectory() as place:
            if name in FORKED:
                row = kill_forks(name, numbers[name], Path(place))
            else:
                victim = Victim(name, numbers[name], Path(place), seed + len(name))
                try:
                    row = victim.live()
                finally:
                    if victim.result["differs"] or "says" in victim.result:
                        print(victim.log.read_text()[-6000:], file=sys.stderr)
        print(name, row, file=sys.stderr, flush=True)
        return row

    with ThreadPoolExecutor(2) as pool:
        found = dict(zip(names, pool.map(one, names), strict=True))
    lost = ("not_continued", "went_back", "checkpoints_lost", "damaged")
    rows = list(found.values())
    same = [row.get("same_figures", row.get("same_bits_as_the_unbroken_run")) for row in rows]
    return {
        "kills": sum(row["kills"] for row in rows),
        "lost": sum(row.get(key, 0) for row in rows for key in lost),
        "processes_left": sum(row.get("processes_left", 0) for row in rows),
        "same_bits": False not in same,
        "runs": found,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--runs", nargs="*", choices=[*FORKED, *RUNS])
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print(json.dumps(kill_all(arguments.kills, arguments.runs, arguments.seed)))
