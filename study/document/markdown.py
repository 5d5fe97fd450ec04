"""A document as Markdown, for a README or a pull request."""

from __future__ import annotations

from collections.abc import Iterable
from urllib.parse import quote

from study.document.blocks import Block, Heading, Paragraph, Picture, Table

MARKS = {"l": "---", "c": ":-:", "r": "--:"}


def markdown(blocks: Iterable[Block]) -> str:
    """Return the text of a document; its title is a heading of the second level."""
    return "\n\n".join(map(_block, blocks)) + "\n"


def _block(block: Block) -> str:
    match block:
        case Heading(level, text):
            return f"#{'#' * level} {text}"
        case Paragraph(text, notice):
            return "> " * notice + text
        case Table(header, align, rows, caption, notes):
            marks = "|".join(MARKS[side] for side in align)
            lines = [_row(header), f"|{marks}|", *map(_row, rows)]
            return "\n\n".join(part for part in (caption, "\n".join(lines), notes) if part)
        case Picture(file, caption, alt):  # pages do not show a PDF inside: it becomes a link
            shown = "" if file.lower().endswith(".pdf") else "!"
            return f"{shown}[{alt}]({quote(file)})\n\n*{caption}*"


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
