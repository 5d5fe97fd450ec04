"""A document as data: headings, paragraphs, tables and figures, whose texts are inline Markdown.

Inline Markdown here is `code`, **bold**, *italic*, a backslash before a character that stands for itself, and, in a
table's cell, `<br>` for a new line.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass


class Inline(str):
    """Text that is inline Markdown already."""

    __slots__ = ()


def plain(text: object) -> Inline:
    """Return words from outside as inline Markdown that shows them as they are; Inline stays as it is."""
    if isinstance(text, Inline):
        return text
    return Inline(re.sub(r"([\\`*_\[\]|~#<&])", r"\\\1", re.sub(r"\s+", " ", str(text))))


def code(text: object) -> Inline:
    """Return words from outside in fixed width."""
    return Inline(f"`{' '.join(re.sub(r'[`|]', ' ', str(text)).split())}`")


def bold(text: object) -> Inline:
    """Return words from outside in bold."""
    return Inline(f"**{plain(text)}**")


def italic(text: object) -> Inline:
    """Return words from outside in italics."""
    return Inline(f"*{plain(text)}*")


def lines(parts: Sequence[object]) -> Inline:
    """Return the lines of a table's cell."""
    return Inline("<br>".join(map(plain, parts)))


@dataclass(frozen=True)
class Heading:
    """A heading: 1 is the document's title."""

    level: int
    text: str


@dataclass(frozen=True)
class Paragraph:
    """A paragraph; a notice stands out."""

    text: str
    notice: bool = False


@dataclass(frozen=True)
class Table:
    """A table: `align` has l, c or r for each column; `notes` stand below it."""

    header: tuple[str, ...]
    align: str
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    notes: str = ""


@dataclass(frozen=True)
class Picture:
    """A figure in a file, its caption, and what it shows in words."""

    file: str
    caption: str
    alt: str


Block = Heading | Paragraph | Table | Picture


def table(header: Sequence[str], rows: Iterable[Sequence[object]], left: int = 1) -> Inline:
    """Return a table's lines for a text, its first `left` columns flush left, the others flush right.

    The header is inline Markdown; what is no `Inline` in a row is escaped.
    """
    marks = ["---"] * left + ["--:"] * (len(header) - left)
    return Inline(
        "\n".join(f"| {' | '.join(map(plain, row))} |" for row in (map(Inline, header), map(Inline, marks), *rows))
    )


def parse(text: str, pictures: Mapping[str, str]) -> Iterator[Block]:
    """Yield the blocks of a text, which blank lines separate, except between a table's caption and its header.

    `#` starts a heading and `>` a notice. `Table: CAPTION` is followed by a header, a line of alignments, rows, and
    notes; a table without any row is left out. `Figure: NAME` is followed by a caption and `Alt:` with the same in
    words; a figure that is not in `pictures`, by name its file, is left out.
    """
    for block in filter(None, (part.strip() for part in re.split(r"\n\s*\n(?!\|)", text))):
        words = " ".join(block.split())
        if heading := re.fullmatch(r"(#+) (.*)", words):
            yield Heading(len(heading[1]), heading[2])
        elif figure := re.fullmatch(r"Figure: (\S+) (.*) Alt: (.*)", words):
            if figure[1] in pictures:
                yield Picture(pictures[figure[1]], figure[2], figure[3])
        elif match := re.fullmatch(r"Table:(.*?)((?:^\|[^\n]*\n?)+)(.*)", block, re.DOTALL | re.MULTILINE):
            header, marks, *rows = (_cells(line) for line in match[2].splitlines())
            caption, notes = (" ".join(part.split()) for part in (match[1], match[3]))
            align = "".join("c" if mark[0] == ":" else "r" if mark[-1] == ":" else "l" for mark in marks)
            if rows:
                yield Table(header, align, tuple(rows), caption, notes)
        else:
            yield Paragraph(words.removeprefix("> "), words.startswith("> "))


def _cells(line: str) -> tuple[str, ...]:
    return tuple(cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1])
