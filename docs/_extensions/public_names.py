"""Lets a docstring name anything public by its short name, and shows how classes are made.

A short name is never ambiguous; signatures that metaclasses hide and docstrings that TensorClass
replaces are read from the source.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import textwrap
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.inspect import stringify_signature

PACKAGES = (
    "torchrl_hmcts.planners",
    "torchrl_hmcts.objectives",
    "torchrl_hmcts.modules",
    "torchrl_hmcts.transforms",
    "torchrl_hmcts.envs",
    "torchrl_hmcts.trainers",
    "torchrl_hmcts.testing",
)


def public_names() -> dict[str, str]:
    """Map each public name to the path under which it is documented."""
    return {
        name: f"{package}.{name}"
        for package in PACKAGES
        for name in importlib.import_module(package).__all__
    }


def resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, text: nodes.TextElement
) -> nodes.reference | None:
    """Find what a reference in a docstring means by its first public name."""
    if node.get("refdomain") != "py":
        return None
    parts = node["reftarget"].split(".")
    for i, part in enumerate(parts):
        path = env.public_names.get(part)
        if path is not None:
            target = ".".join([path, *parts[i + 1 :]])
            found: Any = env.domains.python_domain.resolve_xref(
                env, node["refdoc"], app.builder, "obj", target, node, text
            )
            return found
    return None


_CODE = re.compile(r"(?:[a-z_]+\.)*([A-Za-z_]\w+)(?:\(.*\))?")
_WORDS = {"learn", "solve"}  # public functions, and methods of an agent as well


def link_code(app: Sphinx, doctree: nodes.document) -> None:
    """Make each public name in the code of a page a link to its reference."""
    docname = app.env.docname
    if docname.startswith("auto_reference"):
        return
    for literal in list(doctree.findall(nodes.literal)):
        match = _CODE.fullmatch(literal.astext())
        path = app.env.public_names.get(match[1]) if match and match[1] not in _WORDS else None
        inside = (nodes.reference, nodes.title, pending_xref)
        if path is None or any(isinstance(node, inside) for node in _above(literal)):
            continue
        options = {"refdomain": "py", "reftype": "obj", "reftarget": path, "refexplicit": True}
        link = pending_xref("", refdoc=docname, refwarn=False, **options)
        literal.replace_self(link)
        link += literal


def _above(node: nodes.Node) -> list[nodes.Node]:
    found = []
    while node.parent is not None:
        node = node.parent
        found.append(node)
    return found


def signature(
    app: Sphinx,
    what: str,
    name: str,
    obj: Any,
    options: Any,
    text: str | None,
    returned: str | None,
) -> tuple[str, str | None] | None:
    """Return the signature of a class's own ``__init__`` where a metaclass hides it."""
    if what == "class" and type(obj).__name__ == "_TensorClassMeta":
        return "", None  # its fields are listed
    if what != "class" or text is None or not text.startswith("(*args"):
        return None
    shown = inspect.signature(obj.__init__)
    parameters = list(shown.parameters.values())[1:]
    shown = shown.replace(parameters=parameters, return_annotation=inspect.Signature.empty)
    return stringify_signature(shown, unqualified_typehints=True), returned


def tensorclass_docstring(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Put back the docstring that tensordict's TensorClass replaces, and the fields' comments."""
    if what != "class" or type(obj).__name__ != "_TensorClassMeta":
        return
    source = textwrap.dedent(inspect.getsource(obj))
    text = ast.get_docstring(ast.parse(source).body[0]) or ""  # type: ignore[arg-type]
    fields = re.findall(r"^    (\w+): ([\w.\[\], |]+?)(?:  # (.*))?$", source, re.MULTILINE)
    lines[:] = [*text.splitlines(), ""]
    for field, kind, comment in fields:
        meaning = re.sub(r"(\[[^\]]+\])", r"``\1``", comment)
        lines.append(f"* **{field}** ({kind}){': ' if meaning else ''}{meaning}")
    lines.append("")


def skip_foreign(
    app: Sphinx, what: str, name: str, obj: Any, skip: bool, options: Any
) -> bool | None:
    """Leave out what a decorator of tensordict put into a class of ours, and fields of tuples.

    The fields of a NamedTuple are among the Attributes of its docstring already.
    """
    if type(obj).__name__ == "_tuplegetter":
        return True
    function = getattr(obj, "fget", None) or getattr(obj, "__func__", obj)
    module = getattr(function, "__module__", None) or ""
    return True if module.startswith(("tensordict", "torch.", "torchrl.")) else None


def setup(app: Sphinx) -> dict[str, Any]:
    def remember(app: Sphinx) -> None:
        app.env.public_names = public_names()

    app.connect("builder-inited", remember)
    app.connect("missing-reference", resolve)
    app.connect("doctree-read", link_code)
    app.connect("autodoc-process-signature", signature)
    app.connect("autodoc-skip-member", skip_foreign)
    app.connect("autodoc-process-docstring", tensorclass_docstring, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
