"""A page of figures: what stands on it, as data; ``page.html.j2`` says how it looks."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_hmcts.trainers.saving.files import write_text

_MEDIA = {".png": "image/png", ".gif": "image/gif"}


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    value: Any  # as `plain` writes it
    beside: str = ""  # small words behind it
    below: Sequence[str] = ()  # small lines below it
    title: str = ""  # shown where the mouse rests
    kind: str = ""  # class of a value with a title
    code: bool = False  # whether it is typed
    link: str = ""  # address it leads to
    color: str = ""  # of a square before it
    number: bool | None = None  # set to the right; None: if the value is a number

    def __post_init__(self) -> None:
        if self.number is None:
            number = isinstance(self.value, int | float) and not isinstance(self.value, bool)
            object.__setattr__(self, "number", number)


class Table:
    """A table of cells or values; a column of numbers is set to the right, its head too.

    It scrolls where it is wider than the page; of kind ``"stack"``, it sets the third cell of a row
    below the first two on a phone.
    """

    def __init__(
        self,
        rows: Sequence[Sequence[Any]],
        head: Sequence[Any] = (),
        title: str = "",
        kind: str = "wide",
    ) -> None:
        self.title, self.kind = title, kind
        self.rows = [[x if isinstance(x, Cell) else Cell(x) for x in row] for row in rows]
        first = self.rows[0] if self.rows else [Cell("")] * len(head)
        self.head = [
            Cell(getattr(name, "value", name), color=getattr(name, "color", ""), number=cell.number)
            for name, cell in zip(head, first, strict=bool(head))
        ]


@dataclass(frozen=True)
class Picture:
    """A picture with its caption."""

    source: str  # address or embedded data
    alt: str  # read out by screen readers
    caption: str = ""
    video: str = ""  # address of the same as a video
    broad: bool = False  # whether it scrolls on a phone instead of shrinking


@dataclass(frozen=True)
class Section:
    """A heading and the fields below it in their order; left out if they are empty."""

    title: str = ""
    words: Sequence[str] = ()  # paragraphs
    link: tuple[str, str] | None = None  # address, and the words that lead to it
    code: Sequence[str] = ()  # lines as they are typed
    pictures: Sequence[Picture] = ()  # side by side
    panels: Sequence[Picture] = ()  # smaller ones
    columns: Sequence[Table] = ()  # side by side
    tables: Sequence[Table] = ()  # one below the other
    inside: Sequence[Section] = ()
    folded: bool = False  # until a click

    @property
    def filled(self) -> bool:
        """Is true if anything stands below the heading."""
        return any(
            (self.link, self.code, self.pictures, self.panels, self.columns, self.tables)
        ) or bool(self.inside or (self.words and not self.title))


def write_sections(path: str | Path, title: str, sections: Sequence[Section]) -> None:
    """Write a page in one move."""
    # Here, so that a run without it loses no more than its page.
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folder = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=folder,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters["plain"] = plain
    template = environment.get_template("page.html.j2")
    write_text(path, template.render(title=title, sections=sections).lstrip())


def plain(value: Any) -> str:
    """Return a value as people read it: four digits, thousands apart."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1_000 else f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(map(plain, value)) or "-"
    return json.dumps(value) if isinstance(value, Mapping) else str(value)


def picture(path: Path, caption: str = "", *, embed: bool) -> Picture:
    """Return a picture, with a link to the video of the same name if there is one."""
    ending = path.suffix.lower()
    video = path.with_suffix(".mp4")
    return Picture(
        _embedded(path.read_bytes(), _MEDIA[ending]) if embed else path.name,
        caption or path.stem,
        caption,
        video.name if ending == ".gif" and video.is_file() and not embed else "",
        ending == ".png" and _width(path) > 700,
    )


def drawing(svg: str, name: str) -> Picture:
    """Return an SVG drawing, embedded as a picture: it can run nothing and styles nothing else."""
    return Picture(_embedded(svg.encode(), "image/svg+xml"), name)


def _embedded(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _width(path: Path) -> int:
    """Pixels of a PNG; 0 of what is none."""
    head = path.read_bytes()[:24] if path.is_file() else b""
    return int.from_bytes(head[16:20], "big") if head[12:16] == b"IHDR" else 0
