"""The page of a run: its figures and pictures in one HTML file."""

from __future__ import annotations

import html
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from torchrl_hmcts import __version__

_STYLE = """
:root { color-scheme: light dark; --line: #d4d4d8; }
body { font: 16px/1.5 system-ui, sans-serif; margin: 0 auto; max-width: 68rem; padding: 1rem; }
h1 { font-size: 1.5rem; line-height: 1.25; }
figure { margin: 1.5rem 0; }
img { max-width: 100%; height: auto; border: 1px solid var(--line); background: #fff; }
figcaption { color: #71717a; font-size: .95rem; }
table { border-collapse: collapse; width: 100%; }
td { border-bottom: 1px solid var(--line); padding: .3rem .5rem; overflow-wrap: anywhere; }
td:last-child { text-align: right; font-variant-numeric: tabular-nums; }
"""


def versions() -> dict[str, str]:
    """Return the versions that a run's figures depend on, by package.

    Example:
        >>> sorted(versions())
        ['python', 'torch', 'torchrl_hmcts']
    """
    return {
        "torchrl_hmcts": __version__,
        "torch": metadata.version("torch"),
        "python": platform.python_version(),
    }


def write_page(
    path: Path, *, title: str, metrics: Mapping[str, Any], pictures: Mapping[str, str]
) -> None:
    """Write a page that shows figures and pictures; whatever it shows is escaped.

    Args:
        path: file to write; pictures lie beside it.
        title: heading of the page.
        metrics: figures by name; nested mappings become groups of rows.
        pictures: caption of each picture file.
    """
    escape = html.escape
    figures = "\n".join(
        f'<figure><img src="{escape(name)}" alt="{escape(caption)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
        for name, caption in pictures.items()
    )
    rows = "\n".join(
        f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>"
        for name, value in _flatten(metrics)
    )
    path.write_text(
        f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>{escape(title)}</h1>
{figures}
<h2>Figures</h2>
<table>{rows}</table>
</body>
</html>
"""
    )


def _flatten(metrics: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            rows += _flatten(value, f"{prefix}{name}.")
        else:
            rows.append((prefix + name, f"{value:,}" if isinstance(value, int) else str(value)))
    return rows
