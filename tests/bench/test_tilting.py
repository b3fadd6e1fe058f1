"""Without a browser or a portal there is no tilt, and why is said in words."""

from __future__ import annotations

import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest

import relay_server
from bench.report import Unavailable
from bench.tilting import tilts


def measure() -> None:
    """Nothing is asked of relay and robot before there is what it takes."""
    tilts(Mock(spec_set=[]), Mock(spec_set=[]), "driver", "correct horse", 1)


def test_without_chromium_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """And how to get it."""
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(Unavailable, match=r"no Chromium .*apt install"):
        measure()


def test_without_the_portal_it_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """And how to build it."""
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(relay_server, "PORTAL", tmp_path)
    with pytest.raises(Unavailable, match=r"not built .*make web"):
        measure()
