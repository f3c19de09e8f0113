"""Pages and docstrings are in plain English: a list of mannerisms has a budget near zero."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MANNERISMS = re.compile(
    r"\b(go(es|ing|ne)? on\b|went on\b|anew\b|carr(y|ies|ied|ying) (it |them |\w+ plans? )?out\b"
    r"|whatever\b|said there|the source'?s?\b(?! (code|of options|text))|for ever\b|in earnest\b"
    r"|what c[oa]mes? of\b|(say|says|tells?) (where|how) (it|they) stands?\b|as it stands\b"
    r"|is the most that|thereof\b|thereby\b|where(by|in|upon)\b|hence\b|upon\b|heeds?\b|nobody\b"
    r"|bears? on\b|(is|are|was|were|been|being) told\b(?! apart)|round in a circle)",
    re.IGNORECASE,
)
FIRST = ("README.md", "docs/getting_started.md", "docs/index.md", "docs/glossary.md")
PACKAGES = ("envs", "modules", "objectives", "planners", "testing", "trainers", "transforms")
WORDS_A_MANNERISM = 2_000


def found(text: str) -> list[str]:
    return [match[0] for match in MANNERISMS.finditer(" ".join(text.split()))]


def docstrings(folder: str) -> str:
    parts = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                parts.append(ast.get_docstring(node) or "")
    return "\n".join(parts)


@pytest.mark.parametrize("name", FIRST)
def test_the_first_pages_have_no_mannerism(name: str) -> None:
    assert found((ROOT / name).read_text(encoding="utf-8")) == []


def test_all_pages_have_one_in_two_thousand_words_at_most() -> None:
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *ROOT.glob("docs/tutorials/*")]
    text = "\n".join(p.read_text(encoding="utf-8") for p in pages if "auto_" not in str(p))
    assert len(found(text)) * WORDS_A_MANNERISM <= len(text.split()), found(text)


@pytest.mark.parametrize("folder", ["torchrl_hmcts", "envs", "trainers", "benchmarks"])
def test_docstrings_have_one_in_two_thousand_words_at_most(folder: str) -> None:
    text = docstrings(folder)
    assert len(found(text)) * WORDS_A_MANNERISM <= len(text.split()), found(text)


@pytest.mark.parametrize("folder", ["torchrl_hmcts", "envs", "trainers"])
def test_what_the_code_says_to_users_has_no_mannerism(folder: str) -> None:
    for path in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Raise) and node.exc is not None:
                parts = [n.value for n in ast.walk(node.exc) if isinstance(n, ast.Constant)]
                assert found("".join(filter(lambda part: isinstance(part, str), parts))) == [], path


def test_the_list_finds_what_it_names_and_spares_code() -> None:
    said = "Carried\n out anew, it goes on whatever the source says. Hence say where it stands."
    assert len(found(said)) == 7
    assert found("the source of options, the source code, carry the state") == []


@pytest.mark.parametrize("package", PACKAGES)
def test_public_docstrings_begin_with_a_noun_or_a_verb(package: str) -> None:
    module = importlib.import_module(f"torchrl_hmcts.{package}")
    wrong = []
    for name in module.__all__:
        value = getattr(module, name)
        members = {name: value}
        if inspect.isclass(value):
            own = {k: v for k, v in vars(value).items() if not k.startswith("_")}
            members |= {f"{name}.{k}": v for k, v in own.items()}
        for full, member in members.items():
            doc = inspect.getdoc(member) if callable(member) or isinstance(member, property) else ""
            if re.match(r"(What|Where|How|Whether|Why)\b", doc or ""):
                wrong.append(full)
    assert not wrong
