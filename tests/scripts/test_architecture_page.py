"""Files, folders and classes that the documentation names exist."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
EXPLANATIONS = [page for page in sorted(ROOT.glob("docs/explain/*.md")) if page.name != "safety.md"]
PICTURE = ROOT / "docs/images/architecture.svg"
PRODUCT = ("relay_server", "robot_client", "protocol/relay_protocol", "db/relay_db")
BASES = ("", *PRODUCT, "web_client/src", "docs")
"""Folders that paths are relative to."""
BASES_OF_PAGES = {"conformance.md": ("tests/conformance",)}

BLOCK = re.compile(r"```.*?```", re.DOTALL)
NAME = re.compile(r"`([^`\n]+)`")
PATH = re.compile(r"(?:[A-Za-z_.][\w.-]*/)*[A-Za-z_][\w.-]*(?:/|\.(?:py|ts|svelte|ttl|md|json|sh))\Z")
CLASS = re.compile(r"([A-Z][a-z]\w+)(?:\.([a-z_]+))?\Z")
DEFINITION = re.compile(r"^class ([A-Za-z_]\w*)", re.MULTILINE)
RCLPY = {"MessageInfo"}


@cache
def _classes() -> dict[str, str]:
    """Classes of the product, each with the text of the file that defines it."""
    texts = [path.read_text() for folder in PRODUCT for path in (ROOT / folder).rglob("*.py")]
    return {name: text for text in texts for name in DEFINITION.findall(text)}


def _names(page: Path) -> list[str]:
    return NAME.findall(BLOCK.sub("", page.read_text()))


def _missing(page: Path, names: list[str]) -> list[str]:
    bases = [page.parent, *(ROOT / base for base in (*BASES, *BASES_OF_PAGES.get(page.name, ())))]
    paths = [name for name in names if PATH.match(name)]
    return [path for path in paths if not any((base / path).exists() for base in bases)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_and_folders_that_a_page_names_exist(page: Path) -> None:
    assert _missing(page, _names(page)) == []


def test_files_and_folders_in_the_picture_of_the_architecture_exist() -> None:
    words = re.sub(r"<[^>]*>", " ", PICTURE.read_text()).split()
    assert "sessions/" in words
    assert _missing(PICTURE, words) == []


@pytest.mark.parametrize("page", EXPLANATIONS, ids=lambda page: page.name)
def test_classes_and_members_that_an_explanation_names_are_defined(page: Path) -> None:
    names = [match.groups() for name in _names(page) if (match := CLASS.match(name))]
    found = [each for each in names if each[0] not in RCLPY]
    assert [name for name, _ in found if name not in _classes()] == []
    members = [(name, member) for name, member in found if member]
    assert [each for each in members if not re.search(rf"\b{each[1]}\b", _classes()[each[0]])] == []
