"""Words in letters of several lines, which can be read from some metres away."""

from __future__ import annotations

_ROWS = 5
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"
_PIXELS = (  # five rows of three pixels each, as octal digits
    "25755 65656 34443 65556 74647 74644 34553 55755 72227 11152 55655 44447 57755 65555 25552 65644 25563 "
    "65655 34216 72222 55557 55552 55775 55255 55222 71247 75557 26227 61247 61216 55711 74616 34757 71222 "
    "75757 75716"
)
_WIDE = {
    "M": ("10001", "11011", "10101", "10001", "10001"),
    "N": ("1001", "1101", "1011", "1001", "1001"),
    "W": ("10001", "10001", "10101", "11011", "10001"),
}
_GLYPHS = {
    letter: tuple(f"{int(row):03b}" for row in rows)
    for letter, rows in zip(_LETTERS, _PIXELS.split(), strict=True)
} | _WIDE
"""Five rows of pixels of each character; most are three pixels wide."""


def big_word(word: str, columns: int, rows: int) -> list[str]:
    """Return the lines of a word of letters and digits, as big as fits; the word itself if it does not fit.

    Args:
        word: the word; other characters are left out.
        columns: columns of the screen.
        rows: rows for the word.
    """
    glyphs = [_GLYPHS[letter] for letter in word.upper() if letter in _GLYPHS]
    # A character cell is twice as high as wide.
    pixels = sum(len(glyph[0]) + 1 for glyph in glyphs)
    scale = min((columns + 1) // max(1, 2 * pixels), rows // _ROWS)
    if not glyphs or scale < 1:
        return [word]
    lines = []
    for row in range(_ROWS):
        bits = "0".join(glyph[row] for glyph in glyphs)
        line = "".join(("█" if bit == "1" else " ") * 2 * scale for bit in bits)
        lines += [line.rstrip()] * scale
    return lines
