"""The code of README and docs runs as it stands, each page in one session from top to bottom."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.filterwarnings("ignore::DeprecationWarning:gymnasium_robotics")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # without a display
@pytest.mark.filterwarnings("ignore:failed to load GLFW")
def test_every_python_block_of_the_readme_runs(capsys, tmp_path, monkeypatch):
    pytest.importorskip("gymnasium_robotics")
    monkeypatch.chdir(tmp_path)  # it writes a film and a folder
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert len(blocks) >= 1
    namespace: dict = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), namespace)  # noqa: S102
    said = capsys.readouterr().out
    (shown,) = re.findall(
        r"```\n\n```text\n(Learning.*?plan_seconds=)", README.read_text(), re.DOTALL
    )
    assert shown in said
    assert (tmp_path / "maze.gif").stat().st_size > 1000


def test_pictures_and_links_of_the_readme_exist():
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", README.read_text()):
        assert (README.parent / target).exists(), f"README links to {target}, which does not exist"


@pytest.mark.filterwarnings("ignore:SACTrainer is an experimental:UserWarning")
@pytest.mark.filterwarnings("ignore:The 'post_loss' hook stage:FutureWarning")
@pytest.mark.filterwarnings("ignore:The 'optimizer' hook stage:FutureWarning")
@pytest.mark.parametrize(
    ("name", "least"), [("planning.md", 7), ("skills.md", 7), ("kits.md", 2), ("atari.md", 2)]
)
def test_every_python_block_of_a_page_runs(name, least, capsys):
    if name in ("atari.md", "planning.md"):
        pytest.importorskip("ale_py" if name == "atari.md" else "minigrid")
    page = README.parent / "docs" / name
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)
    assert len(blocks) >= least
    namespace: dict = {}
    for block in blocks:
        exec(compile(block, str(page), "exec"), namespace)  # noqa: S102
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text()):
        if target.startswith("auto_"):  # made with the site; tests/test_docs_site.py looks
            continue
        assert (page.parent / target).exists(), f"{page.name} links to {target}, which is missing"
