"""Private names of torch, tensordict and torchrl are used at six places at most, each for a reason.

What these packages document as hooks to define (``_step``, ``_reset``, ``_AcceptedKeys`` ...) we
define ourselves, so it does not count; nor does what a subclass of ours assigns.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FILES = [p for name in ("torchrl_hmcts", "envs", "trainers") for p in (ROOT / name).rglob("*.py")]
ALLOWED = {
    "_get_str": "an entry is read in a tenth of the time of td.get: direct_calls.entry",
    "_set_str": "an entry is set in a fifth of the time of td.set: direct_calls.put",
    "_forward_hooks": "no public name tells whether a module has hooks: direct_calls.has_hooks",
    "_forward_pre_hooks": "the same",
    "_kwargs": "no public name tells that inputs go by keyword: direct_calls.is_plain",
}
OTHERS = {  # of other packages
    *("_enabled", "_impl", "_load_data"),  # numba's cache: compiling.py
    *("_exit", "_replace"),  # os._exit; a NamedTuple's
    *("_max_episode_steps", "_destroy"),  # of Gymnasium's TimeLimit, and its Box2D envs
    *("_contact_force_range", "_goal_tol", "_success_timing"),  # of mazes: mujoco_batch.py
    *("_reward_task_id", "_teleport_info", "_terminate_at_goal"),
}
# What is there today: names go, and none comes.
KNOWN = {"_encode_state_dict_value", "_new_unsafe", "_reduce_loss", "_version"}


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name != "_"


def defined(tree: ast.AST) -> Iterator[str]:
    """Yield the names that a module defines or assigns, attributes included."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, (ast.Attribute, ast.Name)) and isinstance(node.ctx, ast.Store):
            yield node.attr if isinstance(node, ast.Attribute) else node.id
        # self.__dict__["_name"] = ...
        elif isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store):
            yield str(getattr(node.slice, "value", ""))


def used(tree: ast.AST) -> Iterator[str]:
    """Yield the private names that a module reads or imports from elsewhere."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.ImportFrom) and not (node.module or "").startswith("torchrl_"):
            yield from (alias.name for alias in node.names)


def foreign(sources: Iterable[str]) -> set[str]:
    """Return the private names that sources use and none of them defines."""
    trees = [ast.parse(source) for source in sources]
    own = {name for tree in trees for name in defined(tree)}
    return {name for tree in trees for name in used(tree) if is_private(name)} - own


def test_no_private_name_of_torchs_family_is_used_without_its_reason() -> None:
    found = foreign(path.read_text() for path in FILES) - OTHERS
    assert found - set(ALLOWED) - KNOWN == set()
    assert set(ALLOWED) - found == set()
    assert len(ALLOWED) <= 6


def test_the_check_finds_what_it_is_for() -> None:
    assert foreign(["env._complete_done(x)"]) == {"_complete_done"}
    assert foreign(["from tensordict.base import _is_leaf"]) == {"_is_leaf"}
    assert foreign(["class A(B):\n    def _step(self): self._x = super()._step()"]) == set()
