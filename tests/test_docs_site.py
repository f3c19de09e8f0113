"""The documentation site names everything, and what its pages say can be run.

The site itself, with its tutorials, is built by ``make docs`` (in .ci/run), not here.
"""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

from torchrl_hmcts.trainers.command_line.words import parse_config, split_words
from torchrl_hmcts.trainers.experiments.registry import DEMO, KITS, find_experiment

DOCS = Path(__file__).parents[1] / "docs"
GENERATED = {"auto_tutorials", "auto_reference", "auto_results", "_build"}
PACKAGES = ("planners", "objectives", "modules", "transforms", "envs", "trainers", "testing")

# Pages whose code other tests run, each beside the tests of what it shows.
RUN_ELSEWHERE = {
    "planning.md": "test_readme.py",
    "skills.md": "test_readme.py",
    "atari.md": "test_readme.py",
    "lab_maze.md": "test_lab_maze.py",
    "algorithms/a3c.md": "test_a3c_trainer.py",
    "algorithms/goal_based_agent.md": "test_goal_planning.py",
}
VERBS = {"demo", "train", "evaluate", "play", "report", "sweep", "data", "list", "completion"}
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)
SHOWN = re.compile(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", re.DOTALL)  # and its output


def pages() -> dict[str, str]:
    """Maps each page's name under docs/ to its text; generated ones are left out."""
    return {
        path.relative_to(DOCS).as_posix(): path.read_text()
        for path in sorted([*DOCS.rglob("*.md"), *DOCS.rglob("*.rst")])
        if not GENERATED & set(path.relative_to(DOCS).parts)
        and path.relative_to(DOCS).parts[0] not in {"tutorials", "_templates"}
    }


PAGES = pages()
TUTORIALS = sorted((DOCS / "tutorials").glob("*.py"))


def toctree_entries(page: str) -> list[str]:
    """Returns the documents that a page's toctrees name, relative to docs/."""
    text = PAGES[page]
    blocks = re.findall(r"```\{toctree\}\n(.*?)```", text, re.DOTALL)
    blocks += re.findall(r"^\.\. toctree::\n((?:[ \t]+.*\n|\n)+)", text, re.MULTILINE)
    entries = []
    for line in "\n".join(blocks).splitlines():
        name = line.strip()
        if name and not name.startswith(":"):
            entries.append((DOCS / page).parent.joinpath(name).resolve())
    return [path.relative_to(DOCS.resolve()).as_posix() for path in entries]


def test_every_page_is_in_one_toctree_and_every_entry_is_a_page() -> None:
    listed = [entry for page in PAGES for entry in toctree_entries(page)]
    assert len(listed) == len(set(listed))
    written = {page.rsplit(".", 1)[0] for page in PAGES} - {"index"}
    generated = {entry for entry in listed if entry.split("/")[0] in GENERATED}
    assert written == set(listed) - generated
    assert generated == {
        f"auto_{x}" for x in ("tutorials/index", "results/index", "reference/command_line")
    }


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_in_the_reference_once(package: str) -> None:
    text = PAGES[f"reference/{package}.rst"]
    assert f".. currentmodule:: torchrl_hmcts.{package}\n" in text
    named = re.findall(r"^ {3}([A-Za-z_]\w*)$", text, re.MULTILINE)
    named += re.findall(r"^\.\. py:data:: (\w+)$", text, re.MULTILINE)
    public = set(importlib.import_module(f"torchrl_hmcts.{package}").__all__)
    assert len(named) == len(set(named))
    assert set(named) == public, (
        f"docs/reference/{package}.rst lacks {sorted(public - set(named))} and names "
        f"{sorted(set(named) - public)}, which is not public: write each name into its group"
    )


def test_short_names_in_docstrings_are_looked_up_in_every_package_of_the_reference() -> None:
    source = (DOCS / "_extensions" / "public_names.py").read_text()
    looked_up = re.findall(r'^    "torchrl_hmcts\.(\w+)",$', source, re.MULTILINE)
    assert sorted(looked_up) == sorted(PACKAGES)


def test_every_public_name_is_named_by_a_guide() -> None:
    guides = "\n".join(text for page, text in PAGES.items() if not page.startswith("reference"))
    named = set(re.findall(r"[A-Za-z_]\w+", " ".join(re.findall(r"`([^`\n]+)`", guides))))
    for package in PACKAGES:
        public = set(importlib.import_module(f"torchrl_hmcts.{package}").__all__)
        assert public <= named, f"no guide names {sorted(public - named)}: add docs/guides.md a row"


def test_pages_import_public_names_only() -> None:
    texts = {**PAGES, "README.md": (DOCS.parent / "README.md").read_text()}
    texts |= {path.stem: path.read_text() for path in TUTORIALS}
    line = re.compile(r"^\s*from (torchrl_hmcts[\w.]*) import (?:\(([^)]*)\)|(.*))$", re.MULTILINE)
    for page, text in texts.items():
        for module, several, one in line.findall(text):
            names = {name.split()[0] for name in (several or one).split(",") if name.strip()}
            public = set(importlib.import_module(module).__all__)
            assert names <= public, f"{page} imports {names - public} of {module}: not public"


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_has_a_title_and_a_picture_and_names_only_what_is_public(path: Path) -> None:
    source = path.read_text()
    tree = ast.parse(source)
    title, rule = (ast.get_docstring(tree) or "").splitlines()[:2]
    assert set(rule) == {"="}
    assert len(rule) >= len(title)
    assert "plt.show()" in source
    for target in re.findall(r":doc:`(?:[^<`]*<)?([^>`]+)>?`", source):
        place = DOCS / target[1:] if target.startswith("/") else DOCS / "tutorials" / target
        assert any(place.with_suffix(end).exists() for end in (".md", ".rst", ".py")), target
    packages = {f"torchrl_hmcts.{package}" for package in PACKAGES}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "") in packages:
            exported = importlib.import_module(node.module or "").__all__
            assert {alias.name for alias in node.names} <= set(exported)


def test_pages_that_lead_to_a_tutorial_lead_to_one_that_exists() -> None:
    assert len(TUTORIALS) >= 6
    stems = {path.stem for path in TUTORIALS}
    for page, text in PAGES.items():
        for stem in re.findall(r"auto_tutorials/(\d\w+)", text):
            assert stem in stems, f"{page} leads to the tutorial {stem}, which does not exist"


RUN_HERE = sorted(p for p, text in PAGES.items() if BLOCK.search(text) and p not in RUN_ELSEWHERE)


def test_every_page_with_code_is_run_by_a_test() -> None:
    assert len(RUN_HERE) >= 4  # here, all that are not named above
    for page, test in RUN_ELSEWHERE.items():
        assert BLOCK.search(PAGES[page])
        assert page.rsplit("/", 1)[-1] in (Path(__file__).parent / test).read_text()


@pytest.mark.filterwarnings("ignore:PPOTrainer is an experimental:UserWarning")
@pytest.mark.filterwarnings("ignore:The 'optimizer' hook stage:FutureWarning")
@pytest.mark.filterwarnings("ignore:The 'post_loss' hook stage:FutureWarning")
@pytest.mark.parametrize("page", RUN_HERE)
def test_every_python_block_of_a_page_runs(page: str, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    namespace: dict = {}
    for block, output in SHOWN.findall(PAGES[page]):
        exec(compile(block, page, "exec"), namespace)  # noqa: S102
        said = capsys.readouterr().out
        assert not output or said.strip() == output.strip()


def commands() -> list[tuple[str, str]]:
    """Returns each ``hmcts`` command of README and pages that can be typed as it stands."""
    texts = {**PAGES, "README.md": (DOCS.parent / "README.md").read_text()}
    found = []
    for page, text in texts.items():
        for line in re.findall(r"(?:^    |`)(hmcts [^`\n#]+)", text, re.MULTILINE):
            if not re.search(r"\.\.\.|=[A-Z]+\b", line):  # NAME, DIR, S stand for something
                found.append((page, line.strip()))
    return sorted(set(found))


@pytest.mark.parametrize(("page", "command"), commands())
def test_every_command_of_the_pages_is_understood(page: str, command: str) -> None:
    pytest.importorskip("omegaconf")
    _, verb, *words = command.split()
    assert verb in VERBS
    if verb not in {"demo", "train"} or not words:  # the bare verb is a name, no command
        return
    if "-m" in words:  # the first of its runs
        words = [word.partition(",")[0] for word in words if word != "-m"]
    own, keys = split_words(words, ["experiment", "kit"])
    experiment = DEMO
    if "kit" in own:
        experiment = find_experiment(own["kit"], KITS)
    elif verb == "train":
        experiment = find_experiment(own["experiment"])
    parse_config(experiment, keys)  # raises


@pytest.mark.parametrize("page", [page for page in PAGES if page.endswith(".md")])
def test_pictures_and_links_of_a_page_exist(page: str) -> None:
    text = re.sub(r"```.*?```", "", PAGES[page], flags=re.DOTALL)
    for target in re.findall(r"\]\((?!https?:)([^)#\s]+)(?:#[^)]*)?\)", text):
        if not GENERATED & set(target.split("/")):
            assert ((DOCS / page).parent / target).exists(), f"{page} leads to {target}"


class TestResultsPage:
    @pytest.fixture
    def module(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.syspath_prepend(str(DOCS / "_extensions"))
        return importlib.import_module("results_page")

    def test_every_file_of_results_is_on_the_page(self, module) -> None:
        page = module.page()
        for name in module.data_files():
            if name not in {"demo/metrics.json"}:  # its figures are a row of demo/seeds.csv
                assert f"../results/{name}" in page, f"{name} is not on the page of results"

    def test_every_data_file_says_how_it_was_made(self, module) -> None:
        listed = module.commands((DOCS / "results" / "README.md").read_text())
        for name in module.data_files():
            if name.endswith((".json", ".csv")):
                data = module.load(DOCS / "results" / name)
                assert module.command_of(name, data, listed), f"no command for docs/results/{name}"

    def test_a_file_of_another_form_is_named(self, module, tmp_path: Path) -> None:
        (tmp_path / "README.md").write_text("")
        (tmp_path / "skills").mkdir()
        (tmp_path / "skills" / "worker.json").write_text('{"runs": []}')
        with pytest.raises(ValueError, match=r"skills/worker.json is not what .* reads"):
            module.page(tmp_path)

    def test_figures_are_those_of_the_data(self, module, tmp_path: Path) -> None:
        (tmp_path / "README.md").write_text("| `skills/training_speed.json` | `run it` |\n")
        (tmp_path / "skills").mkdir()
        (tmp_path / "skills" / "training_speed.json").write_text(
            '{"runs": [{"seed": 7, "ratio": 0.5, "steps_per_second": {"DIAYNTrainer": 1234.4}}]}'
        )
        page = module.page(tmp_path)
        assert "| seed | ratio | steps per second DIAYNTrainer |" in page
        assert "| 7 | 0.5 | 1,234 |" in page
        assert "`run it`" in page
