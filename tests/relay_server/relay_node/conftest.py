"""Callers of the relay's own services."""

from __future__ import annotations

import pytest

from relay_protocol.rights import Level
from tests.worlds.relay import Person, World


@pytest.fixture
def viewer(world: World) -> Person:
    """A viewer without /secret and /vault, who may call no service."""
    world.robot_comes()
    person = world.person(Level.VIEWER, deny=("*:/secret", "*:/vault/*"))
    world.robot_joins()
    return person


@pytest.fixture
def operator(world: World, viewer: Person) -> Person:
    """An operator without /secret and /vault."""
    return world.person(Level.OPERATOR, deny=("*:/secret", "*:/vault/*"))
