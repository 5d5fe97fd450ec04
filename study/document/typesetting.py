"""Typst sets the document as a PDF, and turns its pictures into PNG for viewers that cannot show SVG."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path, PurePosixPath

import typst

from study.document.blocks import Block
from study.figures.style import DOTS

TEMPLATE = Path(__file__).with_name("document.typ")


def typeset(
    title: str, footer: str, blocks: Sequence[Block], pictures: dict[str, bytes], fonts: Sequence[Path] = ()
) -> bytes:
    """Return the PDF of a document and its pictures, with the fonts that Typst brings along, and some others."""
    listed = [{"kind": type(block).__name__, **asdict(block)} for block in blocks]
    content = json.dumps({"title": title, "footer": footer, "blocks": listed}).encode()
    files = {"main.typ": TEMPLATE.read_bytes(), "document.json": content, **pictures}
    # Its type stub does not know of files by name, which its documentation has.
    pdf: bytes = typst.compile(files, format="pdf", ignore_system_fonts=True, font_paths=fonts)  # type: ignore[call-overload]
    return pdf


def rasterise(pictures: dict[str, bytes]) -> dict[str, bytes]:
    """Return SVG pictures as PNG by their names, which end in ".png" then. Matplotlib takes six times as long."""
    if not pictures:
        return {}
    pages = "#pagebreak()".join(f"#image({json.dumps(name)})" for name in pictures)
    source = f"#set page(width: auto, height: auto, margin: 0pt)\n{pages}"
    # The stub lacks files by name here, too. A single page comes as bytes, several as a list.
    painted = typst.compile({"main.typ": source.encode(), **pictures}, format="png", ppi=DOTS, ignore_system_fonts=True)  # type: ignore[call-overload]
    images: list[bytes] = painted if isinstance(painted, list) else [painted]
    return {str(PurePosixPath(name).with_suffix(".png")): image for name, image in zip(pictures, images, strict=True)}
