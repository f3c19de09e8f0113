"""Counts of faults survived, cases fuzzed, runs resumed and contracts kept, for docs/results.

    python benchmarks/reliability.py                    (all but the slow ones)
    python benchmarks/reliability.py kills              (60, of every experiment)
    python benchmarks/reliability.py damage             (1,000 damaged files of each kind)
    python benchmarks/reliability.py fuzz --slow        (100,000 cases)
    python benchmarks/reliability.py ray                (kills processes of a Ray cluster)
    python benchmarks/reliability.py coverage           (reads what `make coverage` measured)

Each part is a file of its own: kills.json, damage.json, fuzz.json, fuzz_slow.json, tests.json,
contracts.json, ray.json, leaks.json, coverage.json, with the command that made it; a test that
fails is named.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
GROUPS = {  # what is counted, and the tests that show it
    "faults_injected_and_survived": [
        "tests/test_fault_checkpoints.py",
        "tests/test_fault_collectors.py",
        "tests/test_a3c_trainer.py::TestProcesses",
        "tests/test_atari_pool.py",
        *("-k", "fault or ends or end or killed or ctrl_c or crashes or die"),
    ],
    "runs_resumed_and_compared": [  # bit for bit, but for A3C's, whose counters are compared
        "tests/test_trainer_resume.py",
        "tests/test_hmcts_trainer.py",
        "tests/test_expert_iteration.py",
        "tests/test_growing_skills.py",
        "tests/test_a3c_trainer.py",
        "tests/test_atari_agent.py",
        "tests/test_determinism.py",
        *("-k", "resumed or goes_on or go_on or stopped or in_pieces"),
    ],
    "runs_repeated_and_compared": [
        "tests/test_determinism.py",
        "tests/test_demo.py",
        "tests/test_a3c_trainer.py",
        *("-k", "same_bits or function_of_its_seed or same_seed or of_a_seed or in_a_process"),
    ],
    "security": ["tests/test_security.py"],
}
CONTRACTS = ["transforms", "losses", "envs"]
EVERY = "slow or not slow"
KILLS, DAMAGE = "benchmarks/kills.py", "tests/test_fault_damage.py"
LEAKS, RAY = (
    "tests/test_fault_leaks.py",
    ("tests/test_fault_collectors.py", "tests/test_sweep_ray.py"),
)


def run_pytest(
    *words: str,
    python: str = sys.executable,
    cwd: Path = ROOT,
    env: Mapping[str, str] = os.environ,
    **further: str,
) -> dict[str, Any]:
    """Run tests; return how many passed, failed and were skipped, and the CPU seconds."""
    begin = os.times()
    command = [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
    done = subprocess.run(command, cwd=cwd, env={**env, **further}, capture_output=True, text=True)
    end = os.times()
    last = (done.stdout.strip().splitlines() or [""])[-1]
    counts: dict[str, Any] = {
        word: int(n) for n, word in re.findall(r"(\d+) (passed|failed|skipped|error)", last)
    }
    bad = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if bad or not counts:
        counts["failures"] = bad or [last]
    seconds = end.children_user + end.children_system
    seconds -= begin.children_user + begin.children_system
    return {**counts, "cpu_seconds": round(seconds, 1)}


def run_script(*words: str) -> dict[str, Any]:
    """Run a script of this repository, whose last line are its figures."""
    done = subprocess.check_output([sys.executable, *words], cwd=ROOT, text=True)
    return json.loads(done.splitlines()[-1])


def fuzz(slow: bool) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "counts"
        result = run_pytest(
            "tests/test_fuzz_constructors.py",
            "tests/test_fuzz_inputs.py",
            *("-m", EVERY if slow else "not slow"),
            *("-k", "not ten_times"),  # which is this, in a process of its own
            TORCHRL_HMCTS_FUZZ_COUNT=str(path),
            TORCHRL_HMCTS_FUZZ_TIMES="10" if slow else "1",
        )
        rows = [line.rsplit(" ", 1) for line in path.read_text().splitlines()]
    cases = {name: int(count) for name, count in rows}
    return {"cases": cases, "all_cases": sum(cases.values()), **result}


def coverage() -> dict[str, Any]:
    """Returns the share of the lines that the tests reach, by folder."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "coverage.json"
        words = ["-m", "coverage", "json", "-q", "-o", str(path)]
        subprocess.run([sys.executable, *words], cwd=ROOT, check=True)
        files = json.loads(path.read_text())["files"]
    found: dict[str, dict[str, Any]] = {}
    for name, file in files.items():
        for group in (Path(name).parts[0], "all"):
            row = found.setdefault(group, {"lines": 0, "reached": 0})
            row["lines"] += file["summary"]["num_statements"]
            row["reached"] += file["summary"]["covered_lines"]
    for row in found.values():
        row["share"] = round(row["reached"] / row["lines"], 4)
    return {"folders": found}


SEPARATE = ["ray", "coverage"]  # what needs more than the extra dev, or a run before


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--damaged", type=int, default=1_000, help="files of each kind")
    parser.add_argument("--slow", action="store_true", help="fuzz 100,000 cases")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "reliability")
    parser.add_argument("parts", nargs="*", help=f"default: all but {', '.join(SEPARATE)}")
    arguments = parser.parse_args()
    kills, damaged, slow = arguments.kills, arguments.damaged, arguments.slow
    parts: dict[str, tuple[str, Callable[[], dict[str, Any]]]] = {
        "kills": (f"kills --kills {kills}", lambda: run_script(KILLS, "--kills", str(kills))),
        "damage": (f"damage --damaged {damaged}", lambda: run_script(DAMAGE, str(damaged))),
        "fuzz": ("fuzz --slow" if slow else "fuzz", lambda: fuzz(slow)),
        "tests": ("tests", lambda: {name: run_pytest(*tests) for name, tests in GROUPS.items()}),
        "contracts": (
            "contracts",
            lambda: {
                kind: run_pytest(f"tests/test_contract_{kind}.py", "-m", EVERY)
                for kind in CONTRACTS
            },
        ),
        "leaks": ("leaks", lambda: run_script(LEAKS)),
        "ray": ("ray", lambda: run_pytest(*RAY, "-m", "slow")),
        "coverage": ("coverage", coverage),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    for part in arguments.parts or [part for part in parts if part not in SEPARATE]:
        if part not in parts:
            parser.error(f"{part!r} is none of {', '.join(parts)}")
        begin, (words, measure) = time.time(), parts[part]
        record = {
            "command": f"python benchmarks/reliability.py {words}",
            "python": platform.python_version(),
            **measure(),
        }
        record["wall_seconds"] = round(time.time() - begin, 1)
        name = words.replace(" --slow", "_slow") if part == "fuzz" else part
        (arguments.out / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n")
        print(json.dumps(record, indent=1), flush=True)


if __name__ == "__main__":
    main()
