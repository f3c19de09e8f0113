"""Writes the page of the command line from what the command itself says."""

from __future__ import annotations

import contextlib
import io
import os
import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

_HEAD = """# Command line

`pip install -e '.[train]'` installs the command `hmcts`. What follows is what it says about itself.
"""


def spoken(words: list[str]) -> str:
    """Return what ``hmcts`` prints, given these words."""
    from torchrl_hmcts.trainers.cli import main

    os.environ["COLUMNS"] = "92"
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main(words)
    return text.getvalue().rstrip()


def page() -> str:
    """Return the page, in Markdown."""
    from torchrl_hmcts.trainers.experiments.registry import EXPERIMENTS

    def block(text: str) -> str:
        return f"```text\n{text}\n```\n"

    overview = spoken(["--help"])
    parts = [_HEAD, block(overview)]
    verbs = re.findall(r"^ {2,4}([a-z]+) {2,}\S", overview, re.MULTILINE)
    for verb in dict.fromkeys(verbs):
        parts += [f"## hmcts {verb}\n", block(spoken([verb, "--help"]))]
    parts.append("## Keys of the experiments\n")
    for name, experiment in EXPERIMENTS.items():
        parts += [
            f"### experiment={name}\n",
            f"{experiment.summary[0].upper()}{experiment.summary[1:]}.\n",
            block(experiment.describe()),
        ]
    return "\n".join(parts)


def setup(app: Sphinx) -> dict[str, Any]:
    def write(app: Sphinx) -> None:
        folder = Path(app.srcdir, "auto_reference")
        folder.mkdir(exist_ok=True)
        (folder / "command_line.md").write_text(page())

    app.connect("builder-inited", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
