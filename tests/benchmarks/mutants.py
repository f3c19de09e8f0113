"""Mutants of the planner and the losses: does a test notice when a line of them is wrong?

    python tests/benchmarks/mutants.py --number 40 --out docs/results/reliability/mutants.json

A mutant is one change of one expression: ``<`` becomes ``<=``, ``+`` becomes ``-``, a number is one
more, ``and`` becomes ``or``, a condition is turned round, ``min`` becomes ``max``. A sample of all
of them is drawn; for each, the tests of that file are run in a copy of the project until one fails.
Error messages and type annotations are not changed.
"""

from __future__ import annotations

import argparse
import ast
import copy
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SKIPPED = {"__init__.py", "drawing.py", "export.py"}  # pictures, not search
FAST = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
TESTS = {  # of a file; others have the general ones of their folder
    "kernels.py": "planner_golden array_search tree_policies stochastic_search subtree_reuse",
    "search.py": "planner_golden array_search planner subtree_reuse",
    "mcts.py": "planner_golden planner subtree_reuse evaluators",
    "tree.py": "planner_golden subtree_reuse array_search",
    "novelty.py": "novelty planner",
    "novelty_kernels.py": "novelty",
    "transpositions.py": "transpositions",
    "chance.py": "stochastic_search",
    "choices.py": "planner_golden planner tree_policies",
    "noise.py": "planner",
    "budget.py": "planner",
    "backups.py": "planner_golden",
    "tree_policies.py": "tree_policies",
    "torchrl_scores.py": "tree_policies",
    "evaluators.py": "evaluators",
    "policy_value.py": "expert_iteration",
    "plan.py": "planner_golden planner hierarchical_policy",
    "control.py": "hierarchical_policy model_control",
    "model_control.py": "model_control",
    "goals.py": "goal_planning subgoal_transform",
    "simulator.py": "planner foreign_envs hierarchical_policy",
    "array_search.py": "array_search",
    "search_data.py": "search_data",
    "scored_descent.py": "tree_policies",
    "tree_rollout.py": "evaluators planner",
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


def run(place: Path, tests: list[str], seconds: float) -> str:
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, **FAST, "PYTHONPATH": str(place), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            words, cwd=place, env=environment, capture_output=True, text=True, timeout=seconds
        )
    except subprocess.TimeoutExpired:
        return "killed (time)"
    if done.returncode in (0, 5):
        return "survived"
    return "killed"


def sound(place: Path, names: list[str], known: dict[str, bool], seconds: float) -> list[str]:
    """Returns the test files that pass as long as nothing is mutated; others tell nothing."""
    for name in names:
        if name not in known:
            known[name] = run(place, [f"tests/test_{name}.py"], seconds) == "survived"
            print(f"test_{name}.py {'passes' if known[name] else 'fails'} unmutated", flush=True)
    return [f"tests/test_{name}.py" for name in names if known[name]]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--number", type=int, default=40, help="mutants to draw")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=600.0, help="of a mutant, at most")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    every: list[tuple[Path, tuple[int, int, str]]] = []
    for folder in ("planners", "objectives"):
        for path in sorted((ROOT / "torchrl_hmcts" / folder).glob("*.py")):
            if path.name not in SKIPPED:
                every += [(path, mutant) for mutant in mutants(path)]
    drawn = random.Random(arguments.seed).sample(every, min(arguments.number, len(every)))
    rows: list[dict[str, Any]] = []
    known: dict[str, bool] = {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        copy_project(place)
        for path, (index, line, what) in drawn:
            inside = place / path.relative_to(ROOT)
            names = TESTS.get(path.name, GENERAL[path.parent.name]).split()
            tests = sound(place, names, known, arguments.seconds)
            original = inside.read_text()
            inside.write_text(mutated(inside, index))
            begin = time.time()
            result = run(place, tests, arguments.seconds) if tests else "no sound test"
            inside.write_text(original)
            rows.append(
                {
                    "file": str(path.relative_to(ROOT)),
                    "line": line,
                    "change": what,
                    "result": result,
                    "seconds": round(time.time() - begin, 1),
                }
            )
            killed = sum(row["result"].startswith("killed") for row in rows)
            tried = sum(row["result"] != "no sound test" for row in rows)
            print(rows[-1], f"{killed}/{tried}", flush=True)
            if arguments.out is not None:
                record = {
                    "command": f"python tests/benchmarks/mutants.py --number {arguments.number} "
                    f"--seed {arguments.seed}",
                    "mutants_possible": len(every),
                    "mutants_tried": tried,
                    "mutants_killed": killed,
                    "killed_share": round(killed / max(1, tried), 3),
                    "mutants": rows,
                }
                arguments.out.parent.mkdir(parents=True, exist_ok=True)
                arguments.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
