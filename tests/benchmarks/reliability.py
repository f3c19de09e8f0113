"""Counts of faults survived, cases fuzzed and runs resumed, for docs/results/reliability.

    python tests/benchmarks/reliability.py                    (all; about half an hour)
    python tests/benchmarks/reliability.py kills --kills 50

Each part is a file of its own: kills.json, fuzz.json, tests.json, leaks.json, with the command that
made it.
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
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
GROUPS = {  # what is counted, and the tests that show it
    "faults_injected_and_survived": [
        "tests/test_fault_checkpoints.py",
        "tests/test_a3c_trainer.py::TestProcesses",
        "tests/test_atari_pool.py::test_an_option_is_run_again_when_its_process_crashes",
        "tests/test_atari_pool.py::test_processes_that_die_again_and_again_are_an_error",
        "tests/test_atari_pool.py::test_killed_processes_do_not_change_a_search",
    ],
    "runs_resumed_and_compared": [
        "tests/test_trainer_resume.py",
        "tests/test_hmcts_trainer.py::"
        "test_a_run_resumed_in_a_new_process_is_the_unbroken_run_bit_for_bit",
        "tests/test_expert_iteration.py::"
        "test_a_run_that_was_stopped_and_loaded_is_the_run_that_never_stopped",
        "tests/test_a3c_trainer.py::TestCheckpoints",
    ],
    "runs_repeated_and_compared": ["tests/test_determinism.py"],
    "security": ["tests/test_security.py"],
}


def run_pytest(*words: str, **environment: str) -> dict[str, Any]:
    """Runs tests; returns how many passed, failed and were skipped, and the CPU seconds."""
    begin = os.times()
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )
    end = os.times()
    last = (done.stdout.strip().splitlines() or [""])[-1]
    counts = {word: int(n) for n, word in re.findall(r"(\d+) (passed|failed|skipped)", last)}
    seconds = end.children_user + end.children_system
    seconds -= begin.children_user + begin.children_system
    return {**counts, "cpu_seconds": round(seconds, 1)}


def kills(number: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "tests/test_fault_kills.py", f"{folder}/run", str(number)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    return json.loads(done.stdout.splitlines()[-1])


def fuzz(slow: bool) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "counts"
        marker = "slow or not slow" if slow else "not slow"
        result = run_pytest(
            "tests/test_fuzz_constructors.py",
            "tests/test_fuzz_inputs.py",
            "-m",
            marker,
            TORCHRL_HMCTS_FUZZ_COUNT=str(path),
            TORCHRL_HMCTS_FUZZ_TIMES="10" if slow else "1",
        )
        rows = [line.rsplit(" ", 1) for line in path.read_text().splitlines()]
    cases = {name: int(count) for name, count in rows}
    return {"cases": cases, "all_cases": sum(cases.values()), **result}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", default=["kills", "fuzz", "tests", "leaks"])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--slow", action="store_true", help="fuzz 100,000 cases")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "reliability")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    command = "python tests/benchmarks/reliability.py"
    for part in arguments.parts:
        begin, words = time.time(), part
        if part == "kills":
            words = f"kills --kills {arguments.kills}"
            figures = kills(arguments.kills)
        elif part == "fuzz":
            words = "fuzz --slow" if arguments.slow else "fuzz"
            figures = fuzz(arguments.slow)
        elif part == "tests":
            figures = {name: run_pytest(*tests) for name, tests in GROUPS.items()}
        elif part == "leaks":
            figures = run_pytest("tests/test_fault_leaks.py", "-m", "slow or not slow")
        else:
            parser.error(f"{part!r} is none of kills, fuzz, tests, leaks")
        record = {
            "command": f"{command} {words}",
            "python": platform.python_version(),
            "wall_seconds": round(time.time() - begin, 1),
            **figures,
        }
        (arguments.out / f"{part}.json").write_text(json.dumps(record, indent=1) + "\n")
        print(json.dumps(record, indent=1), flush=True)


if __name__ == "__main__":
    main()
