"""Mutants of the planner and the losses: does a test notice when a line of them is wrong?

    python benchmarks/mutants.py --number 60 --out docs/results/reliability/mutants.json
    python benchmarks/mutants.py --again docs/results/reliability/mutants.json

A mutant is one change of one expression: ``<`` becomes ``<=``, ``+`` becomes ``-``, a number is one
more, ``and`` becomes ``or``, a condition is turned round, ``min`` becomes ``max``. A sample of all
of them is drawn; for each, the tests of that file are run in a copy of the project until one fails.
Error messages and type annotations are not changed.

A call that was stopped continues from its ``--out`` file. ``--again`` runs the survivors of such a
file once more, after tests were added; what the first run found stays in it. Numba compiles a
mutant of the kernels, and of the constants they read, with an empty cache.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import importlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SKIPPED = {"__init__.py", "drawing.py", "export.py"}  # pictures, not search
FAST = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_BESIDE = ("variant_", "batch_", "root_")
KERNELS = {f"{name}kernels.py" for name in ("", *_BESIDE)}
COMPILED = {*KERNELS, "novelty_kernels.py", "tree.py"}  # numba keeps what it made of them
# First, as `make coverage` does, what is fast without compiling.
PLAIN = dict.fromkeys([*KERNELS, "tree.py"], "planner_golden")
PLAIN_WORDS = ["-k", "not approaches"]
_SEARCH = "planner_golden array_search planner subtree_reuse transpositions"
TESTS = {  # of a file; others have the general ones of their folder
    **dict.fromkeys(
        KERNELS,
        f"{_SEARCH} tree_policies stochastic_search planner_reference kernels_in_python",
    ),
    "search.py": f"{_SEARCH} novelty",
    "outcomes.py": "search_numbers planner evaluators",
    "search_loop.py": f"{_SEARCH} waves_in_flight tree_rollout",
    "subtree.py": f"{_SEARCH} novelty tree_rollout",
    "settings.py": "search_numbers planner tree_policies",
    "mcts.py": f"{_SEARCH} evaluators planner_reference",
    "tree.py": f"{_SEARCH} planner_reference tree_drawing",
    "tree_view.py": "tree_drawing planner",
    "novelty.py": "novelty planner",
    "novelty_kernels.py": "novelty kernels_in_python",
    "transpositions.py": "transpositions",
    "root_options.py": "planner_golden planner tree_policies",
    "budget.py": "planner stochastic_search tree_rollout",
    "reference.py": "planner_reference",
    "tree_policies.py": "tree_policies",
    "evaluation.py": "evaluators expert_iteration",
    "random_streams.py": "evaluators planner",
    "evaluators.py": "evaluators expert_iteration",
    "plan.py": "planner_golden planner hierarchical_policy",
    "control.py": "hierarchical_policy model_control goal_planning subgoal_transform",
    "simulator.py": "planner foreign_envs hierarchical_policy",
    "simulator_checks.py": "planning_envs planner",
    "turns.py": "planning_envs foreign_envs",
    "array_search.py": "array_search",
    "search_data.py": "search_data",
    "scored_descent.py": "tree_policies planner_reference",
    "a3c.py": "a3c_loss",
    "option_critic.py": "termination",
    "option_model.py": "option_model",
    "search_distillation.py": "expert_iteration",
    "skill_prior.py": "skill_prior",
    "diayn.py": "diayn_loss continuous_skills",
    "discriminator.py": "diayn_loss skill_objectives",
    "discrete_skill_sac.py": "diayn_loss skill_objectives",
    "skill_sac.py": "continuous_skills",
}
GENERAL = {"planners": "planner planner_golden", "objectives": "skill_objectives diayn_loss"}
# (file, line of source, change, how many like it come before in the line): why no test can notice.
EQUIVALENT: dict[tuple[str, str, str, int], str] = {
    (
        "torchrl_hmcts/planners/novelty.py",
        "while size < 4 * num_features or size <= self._owners.shape[1]:",
        "4 -> 5",
        0,
    ): "how much room a hash table begins with; it holds the same values",
    (
        "torchrl_hmcts/planners/variant_kernels.py",
        'if child >= 0 and nodes[child]["twin"] >= 0:',
        "0 -> 1",
        0,
    ): "node 0 is the root, which no option leads to",
    (
        "torchrl_hmcts/planners/variant_kernels.py",
        'if child >= 0 and nodes[child]["twin"] >= 0:',
        "GtE -> Gt",
        0,
    ): "node 0 is the root, which no option leads to",
    (
        "torchrl_hmcts/planners/kernels.py",
        "lowest = value if value < lowest else lowest",
        "Lt -> LtE",
        0,
    ): "of two equal numbers either is the lower",
    (
        "torchrl_hmcts/planners/novelty.py",
        "while size < 4 * num_features or size <= self._owners.shape[1]:",
        "Mult -> Div",
        0,
    ): "how much room a hash table begins with; it is doubled until a state's values fit",
}
SWAPS: dict[type, type] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
CALLS = {"min": "max", "max": "min", "any": "all", "all": "any", "sum": "mean", "mean": "sum"}


def targets(tree: ast.AST) -> Iterator[ast.AST]:
    """Yields the expressions that may be changed; messages, annotations and defaults may not."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, (ast.Raise, ast.Import, ast.ImportFrom, ast.JoinedStr, ast.arguments)):
            continue
        if isinstance(node, ast.AnnAssign):
            if node.value is not None:
                yield from targets(ast.Expr(node.value))
            continue
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            for inner in node.body:
                yield from targets(ast.Module([inner], []))
            continue
        yield node
        yield from targets(node)


def change(node: ast.AST) -> str | None:
    """Changes a node in place; returns what was done, or None if there is nothing to do."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        old = type(node.ops[0])
        node.ops[0] = SWAPS[old]()
        return f"{old.__name__} -> {SWAPS[old].__name__}"
    if isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in SWAPS:
        old = type(node.op)
        node.op = SWAPS[old]()
        return f"{old.__name__} -> {SWAPS[old].__name__}"
    if isinstance(node, ast.BoolOp):
        old = type(node.op)
        node.op = SWAPS[old]()
        return f"{old.__name__} -> {SWAPS[old].__name__}"
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        node.value += 1
        return f"{node.value - 1} -> {node.value}"
    if isinstance(node, (ast.If, ast.While, ast.IfExp)) and not isinstance(node.test, ast.Constant):
        node.test = ast.UnaryOp(ast.Not(), node.test)
        return "condition turned round"
    if isinstance(node, ast.Call):
        if isinstance(node.func, ast.Attribute) and node.func.attr in CALLS:
            old_name, node.func.attr = node.func.attr, CALLS[node.func.attr]
            return f"{old_name} -> {node.func.attr}"
        if isinstance(node.func, ast.Name) and node.func.id in CALLS:
            old_name, node.func.id = node.func.id, CALLS[node.func.id]
            return f"{old_name} -> {node.func.id}"
    return None


def mutants(path: Path) -> list[tuple[int, int, str]]:
    """Returns (number of the expression, line, change) for each mutant of a file."""
    found = []
    for index, node in enumerate(targets(ast.parse(path.read_text()))):
        done = change(copy.deepcopy(node))
        if done:
            found.append((index, getattr(node, "lineno", 0), done))
    return found


def numbered(path: Path) -> Iterator[tuple[int, int, str, int]]:
    """Yields each mutant of a file, and how many of the same change come before in its line."""
    seen: Counter[tuple[int, str]] = Counter()
    for index, line, what in mutants(path):
        yield index, line, what, seen[line, what]
        seen[line, what] += 1


def mutated(path: Path, index: int) -> str:
    tree = ast.parse(path.read_text())
    node = next(node for i, node in enumerate(targets(tree)) if i == index)
    change(node)
    return ast.unparse(ast.fix_missing_locations(tree))


def copy_project(place: Path) -> None:
    ignore = shutil.ignore_patterns("__pycache__", "benchmarks")
    shutil.copytree(ROOT / "torchrl_hmcts", place / "torchrl_hmcts", ignore=ignore)
    for name in ("envs", "trainers"):
        shutil.copytree(ROOT / name, place / "torchrl_hmcts" / name, ignore=ignore)
    shutil.copytree(ROOT / "tests", place / "tests", ignore=ignore)
    shutil.copytree(ROOT / "docs", place / "docs", ignore=shutil.ignore_patterns("_build", "auto*"))
    shutil.copy(ROOT / "pyproject.toml", place)
    shutil.copy(ROOT / "README.md", place)


def preload() -> None:
    """Imports what every run needs and no mutant changes: each is a fork of this process."""
    os.environ.update(FAST)
    for name in ("torch", "torchrl.collectors", "torchrl.envs", "torchrl.objectives", "numba"):
        importlib.import_module(name)
    if "torchrl_hmcts" in sys.modules:
        raise RuntimeError("What is mutated has been imported unmutated.")


def run_pytest(place: Path, test: str, seconds: int, cache: Path, plain: bool, output: int) -> int:
    """Runs a test file in this process, which is a fork made for it."""
    os.setsid()
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.chdir(place)
    os.environ.update(
        PYTHONPATH=str(place), PYTHONDONTWRITEBYTECODE="1", NUMBA_CACHE_DIR=str(cache)
    )
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    sys.dont_write_bytecode = True
    sys.path[0] = str(place)
    import numba
    import pytest

    numba.config.CACHE_DIR = str(cache)
    numba.config.DISABLE_JIT = int(plain)
    os.environ["NUMBA_DISABLE_JIT"] = str(int(plain))
    sys.argv = ["pytest", "-x", "-q", "-p", "no:cacheprovider", test, *PLAIN_WORDS * plain]
    return int(pytest.main(sys.argv[1:]))


def run(
    place: Path, test: str, seconds: int, cache: Path, plain: bool = False
) -> tuple[str, str, float]:
    """Runs a test file until a test fails; returns the result, which test failed, CPU seconds."""
    with tempfile.TemporaryFile("w+") as output:
        sys.stdout.flush()
        process = os.fork()
        if process == 0:
            code = 70
            try:
                code = run_pytest(place, test, seconds, cache, plain, output.fileno())
                sys.stdout.flush()
            finally:
                os._exit(code)
        end = time.time() + 20 * seconds  # one that waits for ever uses no CPU
        done, status, usage = os.wait4(process, os.WNOHANG)
        while not done and time.time() < end:
            time.sleep(0.05)
            done, status, usage = os.wait4(process, os.WNOHANG)
        with contextlib.suppress(ProcessLookupError):  # also what its tests have started
            os.killpg(process, signal.SIGKILL)
        if not done:
            done, status, usage = os.wait4(process, 0)
            return "killed (time)", test, float(seconds)
        cpu = round(usage.ru_utime + usage.ru_stime, 1)
        code = os.waitstatus_to_exitcode(status)
        output.seek(0)
        text = output.read()
    if code == 0:
        return "survived", "", cpu
    if code in (-signal.SIGXCPU, -signal.SIGKILL) and cpu >= seconds - 1:
        return "killed (time)", test, cpu
    if code < 0:
        return "killed", f"signal {-code} in {test}", cpu
    failures = [line for line in text.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    if not failures:  # nothing collected, a wrong name, a full disk: says nothing of the mutant
        raise RuntimeError(f"pytest ended with {code} and no failed test:\n{text[-2000:]}")
    return "killed", failures[0].split(" - ")[0], cpu


class Bench:
    """A copy of the project, in which one file at a time is changed.

    Args:
        place: Folder of the copy.
        times: CPU seconds of the test files that pass unmutated, and null for those that do not;
            what is missing is measured.
    """

    def __init__(self, place: Path, times: dict[str, float | None]) -> None:
        self.place = place / "project"
        self.cache = place / "numba"
        self.times = times
        copy_project(self.place)

    def tests(self, names: list[str]) -> list[str]:
        """Returns those that pass as long as nothing is mutated, the fastest first."""
        for name in names:
            test = f"tests/test_{name}.py"
            if not (self.place / test).exists():
                raise FileNotFoundError(f"There is no {test}; see TESTS.")
            if name not in self.times:
                result, failed, cpu = run(self.place, test, 600, self.cache)
                self.times[name] = cpu if result == "survived" else None
                print(f"{test} {failed or result} unmutated, {cpu:.0f} s", flush=True)
        return sorted(
            (name for name in names if self.times[name] is not None),
            key=lambda name: self.times[name] or 0.0,
        )

    def try_mutant(self, path: Path, index: int) -> dict[str, Any]:
        """Runs the tests of a file with one expression changed.

        A file of tests may use a minute and twice its CPU seconds, and a minute to compile.
        """
        names = self.tests(TESTS.get(path.name, GENERAL[path.parent.name]).split())
        inside = self.place / path.relative_to(ROOT)
        original, stat = inside.read_text(), inside.stat()
        result, by, seconds = "no sound test", "", 0.0
        with tempfile.TemporaryDirectory() as empty:
            cache = Path(empty) if path.name in COMPILED else self.cache
            inside.write_text(mutated(inside, index))
            try:
                runs = [(PLAIN[path.name], True)] if path.name in PLAIN else []
                for name, plain in runs + [(name, False) for name in names]:
                    limit = 60 + int(2.0 * (self.times[name] or 0.0)) * (not plain)
                    limit += 60 * (path.name in COMPILED and not plain)
                    result, by, cpu = run(self.place, f"tests/test_{name}.py", limit, cache, plain)
                    seconds += cpu
                    if plain and by:
                        by += " without compiling"
                    if result != "survived":
                        break
            finally:
                inside.write_text(original)
                os.utime(inside, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # the cache goes by it
        return {"result": result, "by": by, "cpu_seconds": round(seconds, 1)}


def draw(number: int, seed: int) -> tuple[int, list[dict[str, Any]]]:
    """Returns how many mutants there are, and the rows of a sample of them."""
    every: list[dict[str, Any]] = []
    for folder in ("planners", "objectives"):
        for path in sorted((ROOT / "torchrl_hmcts" / folder).glob("*.py")):
            if path.name in SKIPPED:
                continue
            lines = path.read_text().splitlines()
            for index, line, what, before in numbered(path):
                every.append(
                    {
                        "file": str(path.relative_to(ROOT)),
                        "line": line,
                        "source": lines[line - 1].strip(),
                        "change": what,
                        "before": before,
                        "expression": index,
                    }
                )
    return len(every), random.Random(seed).sample(every, min(number, len(every)))


def find_again(row: dict[str, Any]) -> int:
    """Returns the number of a row's expression, which is another one if the file has changed."""
    path = ROOT / row["file"]
    lines = path.read_text().splitlines()
    same = [
        index
        for index, line, what, before in numbered(path)
        if (lines[line - 1].strip(), what, before) == (row["source"], row["change"], row["before"])
    ]
    if not same:
        raise ValueError(f"{row['file']} has no {row['source']!r} any more; draw a new sample.")
    return min(same, key=lambda index: abs(index - row["expression"]))


def key_of(row: dict[str, Any]) -> tuple[str, str, str, int]:
    return row["file"], row["source"], row["change"], row["before"]


def summary(command: str, possible: int, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns the record of a sample: a mutant that nothing can notice is not in ``share``."""
    for row in rows:
        reason = EQUIVALENT.get(key_of(row))
        if reason is not None and row.get("result") == "survived":
            row["equivalent"] = reason
    tried = [row for row in rows if row.get("result", "no sound test") != "no sound test"]
    first = sum(row["result"].startswith("killed") for row in tried)
    later = sum(row.get("again", "").startswith("killed") for row in tried)
    equivalent = sum("equivalent" in row for row in tried)
    return {
        "command": command,
        "mutants_possible": possible,
        "drawn": len(rows),
        "tried": len(tried),
        "killed_at_first_run": first,
        "killed_after_tests_were_added": later,
        "equivalent": equivalent,
        "survived": len(tried) - first - later - equivalent,
        "killed_share_at_first_run": round(first / max(1, len(tried)), 3),
        "killed_share": round((first + later) / max(1, len(tried)), 3),
        "killed_share_without_equivalent": round(
            (first + later) / max(1, len(tried) - equivalent), 3
        ),
        "mutants": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--number", type=int, default=40, help="mutants to draw")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--again", type=Path, help="file whose survivors are run once more")
    arguments = parser.parse_args()
    out = arguments.again or arguments.out
    record = json.loads(out.read_text()) if out is not None and out.exists() else {}
    command = f"python benchmarks/mutants.py --number {arguments.number} --seed {arguments.seed}"
    if arguments.again:
        command, possible, rows = record["command"], record["mutants_possible"], record["mutants"]
        rows = [row for row in rows if "result" in row]
    else:
        possible, rows = draw(arguments.number, arguments.seed)
        if record and record["command"] != command:
            raise ValueError(f"{out} is of {record['command']!r}; name another file.")
        for row, old in zip(rows, record.get("mutants", []), strict=False):
            if any(row[key] != old.get(key, row[key]) for key in row):
                raise ValueError(f"{out} is of other source files; name another file.")
            row.update(old)
    head = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    commit = record.get("commit") or subprocess.check_output(head, text=True).strip()
    key = "again" if arguments.again else "result"
    preload()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), record.get("cpu_seconds_of_unmutated_tests", {}))
        for row in rows:
            if arguments.again and "survived" != row.get("again", row["result"]):
                continue
            if not arguments.again and "result" in row:
                continue
            if key_of(row) not in EQUIVALENT or key == "result":
                index = find_again(row) if arguments.again else row["expression"]
                tried = bench.try_mutant(ROOT / row["file"], index)
                row[key] = tried.pop("result")
                row.update({"by": tried["by"]} if arguments.again and "by" in tried else tried)
            print(row, flush=True)
            if out is not None:
                done = [row for row in rows if "result" in row]
                out.parent.mkdir(parents=True, exist_ok=True)
                found = {"commit": commit, **summary(command, possible, done)}
                found["cpu_seconds_of_unmutated_tests"] = bench.times
                out.write_text(json.dumps(found, indent=1) + "\n")
    shown = summary(command, possible, rows)
    print({name: value for name, value in shown.items() if name != "mutants"})


if __name__ == "__main__":
    main()
