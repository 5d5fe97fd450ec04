"""Fonts for words in any script: those that come along first, then what this machine has."""

from __future__ import annotations

import unicodedata
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from matplotlib import font_manager

from study.figures.style import FONT, STYLE


@dataclass(frozen=True)
class Fonts:
    """Fonts of a text: `families` for figures and `files` for pages, the first first, and `missing` characters."""

    families: tuple[str, ...] = (FONT,)
    files: tuple[Path, ...] = ()
    missing: tuple[str, ...] = ()  # as U+6F22

    @property
    def warning(self) -> str:
        """Return what to tell readers, or an empty text."""
        if not self.missing:
            return ""
        return f"no font on this machine has {', '.join(self.missing)}; install one, and give the command again"


def fonts_for(text: str) -> Fonts:
    """Return the fonts that have the characters of a text, as far as this machine has any."""
    wanted = {character for character in text if _is_foreign(character)}
    if not wanted:
        return Fonts()
    families, files = [], []
    base = font_manager.findfont(FONT)
    for file in (base, *sorted(font_manager.findSystemFonts())):
        try:
            font = font_manager.get_font(file)
            characters = set(map(chr, font.get_charmap()))
        except (OSError, RuntimeError):  # a font file that matplotlib cannot read
            continue
        if wanted & characters or file == base:
            font_manager.fontManager.addfont(file)
            families.append(font.family_name)
            files.append(Path(file))
            wanted -= characters
        if not wanted:
            break
    return Fonts(tuple(families), tuple(files), tuple(f"U+{ord(character):04X}" for character in sorted(wanted)))


@contextmanager
def lettering(fonts: Fonts) -> Iterator[None]:
    """Draw figures with these fonts."""
    before = STYLE["font.family"]
    STYLE["font.family"] = list(fonts.families)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Glyph .* missing from")  # the report says it
            yield
    finally:
        STYLE["font.family"] = before


def _is_foreign(character: str) -> bool:
    """Return whether the fonts that come along may lack a character: not Latin, nor punctuation, nor mathematics."""
    number = ord(character)
    return number >= 0x250 and not 0x2000 <= number < 0x2C00 and unicodedata.category(character)[0] not in "CZ"
