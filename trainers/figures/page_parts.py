"""Parts of a static page. Whatever is passed as text is escaped; ``Html`` is not."""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

_MEDIA = {".png": "image/png", ".gif": "image/gif", ".svg": "image/svg+xml"}

_STYLE = """
:root { color-scheme: light dark; --line: #d4d4d8; --muted: #63636b; --soft: #f4f4f5;
  --accent: #1d4ed8; }
@media (prefers-color-scheme: dark) {
  :root { --line: #3f3f46; --muted: #a1a1aa; --soft: #27272a; --accent: #93b4ff; } }
* { box-sizing: border-box; }
body { font: 16px/1.55 system-ui, sans-serif; margin: 0 auto; max-width: 72rem;
  padding: 1.5rem 1rem 4rem; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .25rem; }
h2 { font-size: 1.2rem; margin: 2.5rem 0 .75rem; border-bottom: 1px solid var(--line);
  padding-bottom: .25rem; }
h3 { font-size: 1rem; margin: 1.25rem 0 .4rem; }
.lead { color: var(--muted); margin: 0 0 1rem; overflow-wrap: anywhere; }
.pictures { display: grid; gap: 1.25rem; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); }
.panels { display: grid; gap: .75rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 21rem), 1fr)); }
figure { margin: 0; }
.scroll { overflow-x: auto; }
@media (max-width: 700px) { img.broad { max-width: none; width: 40rem; } }
img { display: block; width: auto; max-width: 100%; height: auto; border: 1px solid var(--line);
  border-radius: 6px; background: #fff; margin: 0 auto; }
.panels img { width: 100%; }
figcaption { color: var(--muted); font-size: .92rem; margin-top: .35rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .95rem; }
th, td { border-bottom: 1px solid var(--line); padding: .3rem .8rem .3rem 0; text-align: left;
  vertical-align: top; }
th { font-weight: 600; }
td.number { white-space: nowrap; }
td.number, th.number { text-align: right; }
td.text { overflow-wrap: anywhere; min-width: 6rem; }
td small { color: var(--muted); white-space: nowrap; }
.groups { columns: 21rem; column-gap: 2.5rem; }
.groups > div { break-inside: avoid; margin-bottom: 1rem; }
.name { display: inline-block; min-width: 9rem; }
.groups table { width: 100%; }
.groups td:last-child { text-align: right; }
.groups th:last-child, .groups td:last-child { padding-right: 0; }
.groups h3 { margin-top: .6rem; }
@media (max-width: 600px) {
  .stack tr { display: grid; grid-template-columns: 1fr auto; border-bottom: 1px solid var(--line);
    padding: .3rem 0; }
  .stack tr:has(th) { display: none; }
  .stack td { border: 0; padding: 0; }
  .stack td:nth-child(3) { grid-column: 1 / -1; color: var(--muted); font-size: .9rem; } }
.changed { color: var(--accent); font-weight: 600; }
code, pre { font: .88em/1.5 ui-monospace, monospace; }
pre { background: var(--soft); border-radius: 6px; padding: .6rem .8rem; white-space: pre-wrap;
  overflow-wrap: anywhere; margin: .4rem 0; }
details { margin: 1rem 0; } summary { cursor: pointer; }
.key { display: inline-block; width: .8rem; height: .8rem; border-radius: 3px;
  margin-right: .4rem; }
"""


class Html(str):
    """Text that is HTML already.

    Example:
        >>> text(Html("<b>"))
        '<b>'
    """


def text(value: Any) -> str:
    """Return a value as HTML; strings are escaped.

    Example:
        >>> text("<b>"), text(0.123456), text(12345), text(None)
        ('&lt;b&gt;', '0.1235', '12,345', '-')
    """
    return value if isinstance(value, Html) else html.escape(plain(value))


def plain(value: Any) -> str:
    """Return a value as people read it: four digits, thousands apart.

    Example:
        >>> plain([1, 2.5, True]), plain(1234567.8)
        ('1, 2.5, yes', '1,234,568')
    """
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        if math.isnan(value):
            return "-"
        return f"{value:,.0f}" if abs(value) >= 10_000 else f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(map(plain, value)) or "-"
    if isinstance(value, Mapping):
        return json.dumps(value)
    return str(value)


def picture(path: Path, caption: str | Html = "", *, embed: bool) -> Html:
    """Return a picture with its caption, and a link to the video of the same name if there is one.

    Args:
        path: PNG, GIF or SVG.
        caption: below it, and read out by screen readers.
        embed: put the file into the page; otherwise it must lie beside the page.
    """
    source = path.name
    kind = ' class="broad"' if path.suffix.lower() == ".png" and _width(path) > 700 else ""
    if embed:
        data = base64.b64encode(path.read_bytes()).decode()
        source = f"data:{_MEDIA[path.suffix.lower()]};base64,{data}"
    alt = html.escape(caption or path.stem)
    video = path.with_suffix(".mp4")
    link = ""
    if path.suffix.lower() == ".gif" and video.is_file() and not embed:
        link = f' <a href="{html.escape(video.name)}">As a video</a>'
    shown = f"<figcaption>{text(caption)}{link}</figcaption>" if caption or link else ""
    image = f'<img src="{html.escape(source)}" alt="{alt}"{kind}>'
    return Html(f'<figure><div class="scroll">{image}</div>{shown}</figure>')


def drawing(svg: str, name: str) -> Html:
    """Return an SVG drawing as an embedded picture.

    Args:
        svg: the document.
        name: what it shows.
    """
    data = base64.b64encode(svg.encode()).decode()
    alt = html.escape(name)
    return Html(f'<figure><img src="data:image/svg+xml;base64,{data}" alt="{alt}"></figure>')


def table(rows: Iterable[Sequence[Any]], head: Sequence[Any] = (), kind: str = "wide") -> Html:
    """Return a table; a cell is set to the right if it is a number.

    Args:
        rows: of cells.
        head: of the columns. Default: none.
        kind: ``"wide"`` scrolls where it is wider than the page, ``"stack"`` sets the third cell of
            a row below the first two on a phone.

    Example:
        >>> '<td class="number">3</td>' in table([["solved", 3]])
        True
    """
    lines = []
    rows = [list(row) for row in rows]
    if head:
        kinds = [_kind(cell) for cell in rows[0]] if rows else [""] * len(head)
        names = (
            f'<th class="number">{text(cell)}</th>'
            if kind == "number"
            else f"<th>{text(cell)}</th>"
            for cell, kind in zip(head, kinds, strict=True)
        )
        lines.append("<tr>" + "".join(names) + "</tr>")
    for row in rows:
        cells = (f'<td class="{_kind(cell)}">{text(cell)}</td>' for cell in row)
        lines.append("<tr>" + "".join(cells) + "</tr>")
    return Html(f'<div class="{kind}"><table>{"".join(lines)}</table></div>')


def section(title: str, *parts: str) -> Html:
    """Return a heading and what stands below it; nothing if nothing does."""
    body = "\n".join(part for part in parts if part)
    return Html(f"<h2>{text(title)}</h2>\n{body}" if body else "")


def details(summary: str, *parts: str) -> Html:
    """Return parts that are folded away until asked for."""
    return Html(f"<details><summary>{text(summary)}</summary>\n{''.join(parts)}</details>")


def grid(parts: Iterable[str], kind: str) -> Html:
    """Return parts side by side as far as there is room; ``kind`` pictures, panels or groups."""
    inside = "\n".join(parts)
    return Html(f'<div class="{kind}">{inside}</div>' if inside else "")


def page(title: str, *parts: str) -> str:
    """Return a whole page.

    Args:
        title: shown at the top and in the browser's tab.
        *parts: below it.
    """
    body = "\n".join(part for part in parts if part)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="torchrl_hmcts">
<link rel="icon" href="data:,">
<title>{html.escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>{html.escape(title)}</h1>
{body}
</body>
</html>
"""


def _width(path: Path) -> int:
    """Pixels of a PNG; 0 of what is none."""
    try:
        with path.open("rb") as file:
            head = file.read(24)
    except OSError:
        return 0
    return int.from_bytes(head[16:20], "big") if head[12:16] == b"IHDR" else 0


def _kind(cell: Any) -> str:
    number = isinstance(cell, int | float) and not isinstance(cell, bool)
    return "number" if number or isinstance(cell, Number) else "text"


class Number(Html):
    """A number that is HTML already, e.g. with its interval."""
