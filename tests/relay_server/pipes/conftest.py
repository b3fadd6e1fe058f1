"""Pipes of ann's robot rover."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.worlds.pipes import PipeScene
from tests.worlds.session_manager import SessionsWorld


@pytest.fixture
def scene(front: SessionsWorld) -> Iterator[PipeScene]:
    made = PipeScene(front)
    yield made
    made.service.leave("the test is over")
