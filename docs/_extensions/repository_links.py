"""Makes links that are right in the repository right on the site as well.

A folder of results means the page of results, a file at the top the page made of it.
"""

from __future__ import annotations

import posixpath
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # sphinx and pytest need it there

_LINK = re.compile(r"(?<!!)\]\((?!https?:|#|mailto:)([^)#\s]+)(#[^)]*)?\)")
_PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}


def site_target(page: str, target: str) -> str:
    """Return what a link of a page (``"algorithms/a3c"``) should lead to on the site.

    Example:
        >>> site_target("planning", "results/planner")
        '/auto_results/index.md'
        >>> site_target("algorithms/a3c", "goal_based_agent.md")
        'goal_based_agent.md'
    """
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
    if path.startswith("../"):  # at the top of the repository
        return "/" + _PAGES.get(path[3:], "index.md")
    if path.startswith("results") and not posixpath.splitext(path)[1]:
        return "/auto_results/index.md"
    return target


def repository(root: Path) -> str:
    """Return the public address of the repository in pyproject.toml, or "" where none is known."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    address: str = project.get("urls", {}).get("Repository", "")
    return address


def _rewrite(app: Sphinx, docname: str, source: list[str]) -> None:
    if app.env.doc2path(docname).suffix == ".md":
        source[0] = _LINK.sub(
            lambda match: f"]({site_target(docname, match[1])}{match[2] or ''})", source[0]
        )


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("source-read", _rewrite)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
