"""Docstrings of the product refer to existing names."""

from __future__ import annotations

import ast
import builtins
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = {
    "relay_protocol": ROOT / "protocol/relay_protocol",
    "relay_db": ROOT / "db/relay_db",
    "relay_server": ROOT / "relay_server",
    "robot_client": ROOT / "robot_client",
}
RAISES = re.compile(r":raises ([\w.]+):")
REFERENCE = re.compile(
    r":(?:mod|class|func|meth|data):`~?((?:relay_protocol|relay_db|relay_server|robot_client)[\w.]*)`"
)


def sources() -> dict[Path, str]:
    return {path: path.read_text() for folder in FOLDERS.values() for path in sorted(folder.rglob("*.py"))}


def defined(texts: dict[Path, str]) -> set[str]:
    """All names that are defined or imported anywhere."""
    names = set(dir(builtins))
    for text in texts.values():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.Import | ast.ImportFrom):
                names.update((each.asname or each.name).split(".")[-1] for each in node.names)
    return names


def test_errors_that_are_named_exist() -> None:
    texts = sources()
    known = defined(texts) | {"ClickException", "BadParameter"}
    missing = {
        f"{path.relative_to(ROOT)}: {name}"
        for path, text in texts.items()
        for name in RAISES.findall(text)
        if name.split(".")[-1] not in known
    }
    assert not missing


def exists(reference: str) -> bool:
    """Whether a module has this name, or a class with the name after the module's."""
    package, *names = reference.split(".")
    for count in range(len(names), -1, -1):
        place = FOLDERS[package].joinpath(*names[:count])
        module = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        if module.is_file():
            return count == len(names) or re.search(rf"\b{names[count]}\b", module.read_text()) is not None
    return False


def test_references_of_docstrings_exist() -> None:
    missing = {
        f"{path.relative_to(ROOT)}: {reference}"
        for path, text in sources().items()
        for reference in REFERENCE.findall(text)
        if not exists(reference)
    }
    assert not missing
