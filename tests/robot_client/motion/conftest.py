"""A daemon in memory that receives motion commands."""

import pytest

from tests.worlds.robot_commands import (
    ActionsWorld,
)
from tests.worlds.robot_daemon import RelayEnd, Scene


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def control(scene: Scene) -> RelayEnd:
    return scene.register()


@pytest.fixture
def acting() -> ActionsWorld:
    return ActionsWorld()
