"""Callers of the relay's own services."""

from __future__ import annotations

import pytest

from relay_protocol.rights import Level
from tests.relay_server.memory import Person, World


@pytest.fixture
def viewer(world: World) -> Person:
    """Somebody who sees all but /secret and /vault, and may call nothing."""
    world.robot_comes()
    person = world.person(Level.VIEWER, deny=("*:/secret", "*:/vault/*"))
    world.robot_joins()
    return person


@pytest.fixture
def operator(world: World, viewer: Person) -> Person:
    """Somebody who may call too, except in the vault."""
    return world.person(Level.OPERATOR, deny=("*:/secret", "*:/vault/*"))
