"""The user who drove the robot when its link was lost."""

from __future__ import annotations

import pytest

from relay_protocol import link
from robot_client.motion.link_loss_alert import LinkLossAlert


class Scene:
    """A robot that reports its motion states, and its clock."""

    def __init__(self) -> None:
        self.now = 1000
        self.driven = LinkLossAlert(lambda: self.now)

    def says(self, moving: bool, holder: int = 7) -> None:
        """Report a motion state, a moment later."""
        self.now += 100
        self.driven.note_state(link.MotionState(holder=holder, moving=moving), "ann" if holder else "")


@pytest.fixture
def scene() -> Scene:
    """A robot that was never driven."""
    return Scene()


def test_driver_at_the_loss_is_returned_once(scene: Scene) -> None:
    assert scene.driven.driver_at_loss(None) is None
    scene.says(True)
    assert scene.driven.driver_at_loss(None) == "ann"
    assert scene.driven.driver_at_loss(500) is None


@pytest.mark.parametrize(("proved", "driver"), [(1150, "ann"), (1200, "ann"), (1250, None), (None, None)])
def test_driver_counts_since_the_link_was_last_proved(
    scene: Scene, proved: int | None, driver: str | None
) -> None:
    """The robot stops by itself before it detects the loss."""
    scene.says(True)
    scene.says(False)
    scene.says(False, 0)
    scene.now += 5000
    assert scene.driven.driver_at_loss(proved) == driver


def test_motion_without_a_holder_is_no_driving(scene: Scene) -> None:
    scene.says(True, 0)
    assert scene.driven.driver_at_loss(scene.now) is None
