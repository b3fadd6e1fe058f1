"""The generated pages of docs/reference agree with the code."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

NAMES = ("cli", "settings", "limits", "metrics", "http_api")


@pytest.fixture(scope="module")
def reference() -> ModuleType:
    """The script."""
    spec = importlib.util.spec_from_file_location("reference", Path("scripts/reference.py").resolve())
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", NAMES)
def test_a_page_is_what_the_code_says(reference: ModuleType, name: str) -> None:
    path = reference.FOLDER / f"{name}.md"
    assert path.read_text() == reference.page(f"{name}.md"), "run 'make reference', and commit its pages"


def test_all_generated_pages_are_compared(reference: ModuleType) -> None:
    assert {f"{name}.md" for name in NAMES} == set(reference.PAGES)


def test_settings_without_a_description_are_refused(reference: ModuleType) -> None:
    class Undescribed(reference.config.SpeedSettings, frozen=True):  # type: ignore[misc,name-defined]
        """It says nothing of its setting."""

        jerk: float = 1.0

    with pytest.raises(reference.Missing, match="jerk"):
        list(reference._tables(Undescribed, "limits", "[limits]"))
