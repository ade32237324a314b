"""Keys of the JSON documents that docs/reference/scripts.md describes."""

import re
from pathlib import Path

SCRIPTS = Path(__file__).parents[2] / "docs" / "reference" / "scripts.md"


def documented(command: str, part: str = "") -> set[str]:
    """Return the keys in a table of the page: of a command's document, or of each of a part."""
    section = SCRIPTS.read_text().split(f"\n### {command}\n")[1].split("\n### ")[0]
    table = section.split(f"\nEach of `{part}`:\n")[1] if part else section.split("\nEach of ")[0]
    firsts = re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
    return {key for first in firsts for key in re.findall(r"`(\w+)`", first)}
