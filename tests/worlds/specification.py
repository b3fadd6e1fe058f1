"""The text of the protocol's specification, ``protocol/spec``."""

from __future__ import annotations

import re
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "protocol" / "spec"
INDEX = (FOLDER / "index.md").read_text("utf-8")
PATHS = {
    number: FOLDER / name
    for number, name in re.findall(r"^ *- \[([\d.]+) .*?\]\((\w+\.md)\)$", INDEX, re.MULTILINE)
}
"""The file of each chapter, by its number."""

CHAPTERS = {number: path.read_text("utf-8") for number, path in PATHS.items()}
"""The text of each chapter, by its number."""

SPEC = "\n".join([INDEX, *CHAPTERS.values()])
"""All of it."""


def unwrapped(text: str) -> str:
    """The text without line breaks, so that a phrase is found wherever it is wrapped."""
    return " ".join(text.split())


def section(number: str) -> str:
    """All chapters of one section, such as ``2``."""
    return "\n".join(text for each, text in CHAPTERS.items() if each.split(".")[0] == number)
