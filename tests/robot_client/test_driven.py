"""Who drove the robot when its link was lost."""

from __future__ import annotations

import pytest

from relay_protocol import link
from robot_client.motion.link_loss_alert import LinkLossAlert


class Scene:
    """A robot that tells its relay who moves it, and its clock."""

    def __init__(self) -> None:
        self.now = 1000
        self.driven = LinkLossAlert(lambda: self.now)

    def says(self, moving: bool, holder: int = 7) -> None:
        """It tells, a moment later."""
        self.now += 100
        self.driven.said(link.Safety(holder=holder, moving=moving), "ann" if holder else "")


@pytest.fixture
def scene() -> Scene:
    """Nobody has driven it."""
    return Scene()


def test_who_drives_as_the_link_goes_is_named_once(scene: Scene) -> None:
    """Whatever was answered before; the next loss is another."""
    assert scene.driven.lost(None) is None
    scene.says(True)
    assert scene.driven.lost(None) == "ann"
    assert scene.driven.lost(500) is None


@pytest.mark.parametrize(("proved", "driver"), [(1150, "ann"), (1200, "ann"), (1250, None), (None, None)])
def test_a_robot_that_stood_since_the_relay_was_heard_last_was_driven_then(
    scene: Scene, proved: int | None, driver: str | None
) -> None:
    """It stops itself when nothing proves the link any more, or with its channel, before it knows of the loss."""
    scene.says(True)
    scene.says(False)
    scene.says(False, 0)
    scene.now += 5000
    assert scene.driven.lost(proved) == driver


def test_a_robot_that_nobody_has_is_driven_by_nobody(scene: Scene) -> None:
    """What moves it then is its own."""
    scene.says(True, 0)
    assert scene.driven.lost(scene.now) is None
