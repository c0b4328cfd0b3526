"""The font of the site's formulas: a subset of Latin Modern Math, so that they look the same on every machine.

``python docs/formula_font.py latinmodern-math.otf`` (of CTAN or Debian's fonts-lmodern) writes ``_static/fonts/formulas.woff2``; it needs
fonttools and brotli. The build of the site stops if a formula has a character that is not in :data:`CHARACTERS`.
"""

from __future__ import annotations

import sys
from pathlib import Path

FONT = Path(__file__).resolve().parent / "_static/fonts/formulas.woff2"

_RANGES = (
    "20-7E A0 AC AF B0-B1 B7 D7 2C6-2C7 2D8-2D9 2DC 302-303 307-308 391-3A9 3B1-3C9 3D1 3D5 3F5 2013-2014 "
    "2016 2026 2032-2033 203E 2061-2064 20D7 210E 2190-2194 21A6 21D2 21D4 2200 2202-2203 2207-2208 220F "
    "2211-2213 2217-221A 221D-221E 2223 2225 222B 223C 2248 2260-2261 2264-2265 226A-226B 2295-2297 "
    "22A4-22A5 22C5 22EE-22EF 2308-230B 27E8-27E9 1D434-1D467 1D5A0-1D5B9 1D6E2-1D71B"
)
CHARACTERS = frozenset(
    character
    for part in _RANGES.split()
    for character in range(int(part.split("-")[0], 16), int(part.split("-")[-1], 16) + 1)
)
"""Code points of the subset: letters upright and italic, Latin and Greek, operators, accents and brackets."""


def missing(markup: str) -> set[str]:
    """Return the characters of MathML without its tags that the font lacks."""
    return {character for character in markup if not character.isspace() and ord(character) not in CHARACTERS}


def main(source: str) -> None:
    """Write the subset of a font file."""
    from fontTools import subset, ttLib

    font = ttLib.TTFont(source)
    options = subset.Options(flavor="woff2", layout_features=["ssty"], hinting=False, name_IDs=[0, 1, 4, 6, 7, 13, 14])
    subsetter = subset.Subsetter(options)
    subsetter.populate(unicodes=CHARACTERS)
    subsetter.subset(font)
    for record in font["name"].names:  # a changed font has a name of its own, as its licence asks
        if record.nameID in (1, 4, 6):
            font["name"].setName("StrapdownFormulas", record.nameID, record.platformID, record.platEncID, record.langID)
    subset.save_font(font, str(FONT), options)
    print(f"{FONT}: {FONT.stat().st_size} bytes")


if __name__ == "__main__":
    main(sys.argv[1])
