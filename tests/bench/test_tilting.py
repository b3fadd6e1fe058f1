"""Without a browser or a portal the measurement gives a reason."""

from __future__ import annotations

import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest

import relay_server
from bench.report import Unavailable
from bench.tilting import tilts


def measure() -> None:
    """Neither relay nor robot is used before the prerequisites are there."""
    tilts(Mock(spec_set=[]), Mock(spec_set=[]), "driver", "correct horse", 1)


def test_without_chromium_the_reason_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the way to install it."""
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(Unavailable, match=r"no Chromium .*apt install"):
        measure()


def test_without_the_portal_the_reason_is_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With the way to build it."""
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(relay_server, "PORTAL", tmp_path)
    with pytest.raises(Unavailable, match=r"not built .*make web"):
        measure()
