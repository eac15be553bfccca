"""Text in pictures, in any script that a font of the machine has: Pillow's own font has ASCII letters."""

from __future__ import annotations

import sys
import unicodedata
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

FONT_FOLDERS = {
    "win32": ("C:/Windows/Fonts",),
    "darwin": ("/System/Library/Fonts", "/Library/Fonts", "~/Library/Fonts"),
}.get(sys.platform, ("/usr/share/fonts", "/usr/local/share/fonts", "~/.local/share/fonts", "~/.fonts"))
SUFFIXES = {".ttf", ".otf", ".ttc"}
OTHER_STYLES = ("bold", "italic", "oblique", "light", "mono", "serif", "condensed", "black", "thin", "math")
NO_LETTER = "\uffff"  # drawn as what a font lacks
LETTERS = {
    "ß": "ss",
    "ø": "o",
    "Ø": "O",
    "æ": "ae",
    "Æ": "Ae",
    "ł": "l",
    "Ł": "L",
    "đ": "d",
    "Đ": "D",
    "–": "-",
}


@lru_cache(maxsize=512)
def lettering(text: str, size: int) -> tuple[str, FreeTypeFont]:
    """The text as it can be drawn, and the font for it: Pillow's own if that has all letters, else the font
    of the machine that has most of them. Letters that it lacks become similar ones, or their number
    ("U+9053").

    size: of the font, px
    """
    from PIL import ImageFont

    best: FreeTypeFont = ImageFont.load_default(size)  # type: ignore[assignment]
    lacking = _lacking(text, best)
    for file in fonts() if lacking else ():
        try:
            font = ImageFont.truetype(file, size)
        except OSError:
            continue
        found = _lacking(text, font)
        if len(found) < len(lacking):
            best, lacking = font, found
        if not lacking:
            break
    return "".join(_similar(letter, best) if letter in lacking else letter for letter in text), best


@lru_cache(maxsize=1)
def fonts() -> list[Path]:
    """Font files of the machine, plain ones first."""
    files = [
        file
        for folder in FONT_FOLDERS
        for file in Path(folder).expanduser().rglob("*")
        if file.suffix.lower() in SUFFIXES
    ]
    return sorted(
        files, key=lambda file: (sum(word in file.stem.lower() for word in OTHER_STYLES), file.name)
    )


def _lacking(text: str, font: FreeTypeFont) -> set[str]:
    """Letters of a text that a font does not have."""
    none = font.getmask(NO_LETTER)
    masks = {letter: font.getmask(letter) for letter in set(text) if not letter.isspace() and letter > "~"}
    return {letter for letter, mask in masks.items() if mask.size == none.size and bytes(mask) == bytes(none)}


def _similar(letter: str, font: FreeTypeFont) -> str:
    plain = LETTERS.get(letter) or "".join(
        part for part in unicodedata.normalize("NFKD", letter) if not unicodedata.combining(part)
    )
    return plain if plain and plain != letter and not _lacking(plain, font) else f"U+{ord(letter):04X}"
