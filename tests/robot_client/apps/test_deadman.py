"""The gamepad's deadman button and the curve of its stick."""

from __future__ import annotations

import math

import pytest

from robot_client.apps.joystick import (
    CENTERED,
    FROZEN_SECONDS,
    Deadman,
    DeadmanPhase,
    DriveEnd,
    GamepadState,
    Stick,
    StickCurve,
)

AHEAD = GamepadState(1.0, 0.0, True)
LOOSE = GamepadState(0.0, 0.0, False)


class Hand:
    """A deadman that is polled."""

    def __init__(self) -> None:
        self.deadman = Deadman(StickCurve(dead=0.1, expo=0.0))
        self.now = 0.0

    def look(self, look: GamepadState | None, allowed: bool = True, seconds: float = 0.02) -> Stick | None:
        self.now += seconds
        return self.deadman.update(look, allowed, self.now)

    def drive(self) -> None:
        """Holds the button and pushes the stick."""
        self.look(LOOSE)
        assert self.look(GamepadState(0.0, 0.0, True)) == CENTERED
        assert self.look(AHEAD) == Stick(1.0, 0.0)


def test_the_middle_of_a_stick_is_nothing_and_its_rim_is_all() -> None:
    """The value grows from zero in every direction."""
    curve = StickCurve(dead=0.2, expo=0.5)
    assert curve.apply(GamepadState(0.1, -0.1, True)) == CENTERED
    assert curve.apply(GamepadState(0.2, 0.0, True)) == CENTERED
    assert 0 < curve.apply(GamepadState(0.21, 0.0, True)).ahead < 0.01
    assert curve.apply(GamepadState(-1.0, 0.0, True)) == Stick(-1.0, 0.0)
    corner = curve.apply(GamepadState(1.0, 1.0, True))
    assert math.hypot(*corner) == pytest.approx(1.0)


def test_expo_is_gentle_near_the_middle() -> None:
    """At the rim it has no effect."""
    half = GamepadState(0.5, 0.0, True)
    straight, bent = StickCurve(dead=0.0, expo=0.0), StickCurve(dead=0.0, expo=1.0)
    assert straight.apply(half).ahead == pytest.approx(0.5)
    assert bent.apply(half).ahead == pytest.approx(0.125)
    assert bent.apply(AHEAD).ahead == pytest.approx(1.0)


def test_nonsense_is_nothing() -> None:
    """Invalid numbers move nothing."""
    assert StickCurve().apply(GamepadState(math.nan, 1.0, True)) == CENTERED
    assert StickCurve().apply(GamepadState(math.inf, 0.0, True)) == CENTERED


def test_joystick_needs_its_button() -> None:
    """For any position of the stick."""
    hand = Hand()
    hand.look(LOOSE)
    assert hand.look(GamepadState(1.0, 1.0, False)) is None


def test_driving_begins_with_zero() -> None:
    """Even if the stick is pushed already: a robot follows only a driver that has released before."""
    hand = Hand()
    hand.look(LOOSE)
    assert hand.look(AHEAD) == CENTERED
    assert hand.look(AHEAD) == Stick(1.0, 0.0)


def test_the_button_released_ends_it_and_pressed_again_begins_it() -> None:
    """This is a release by the driver."""
    hand = Hand()
    hand.drive()
    assert hand.look(GamepadState(1.0, 0.0, False)) is None
    assert (hand.deadman.phase, hand.deadman.ended) == (DeadmanPhase.READY, DriveEnd.RELEASED)
    hand.drive()


def test_button_held_at_the_start_does_not_count() -> None:
    """It has to be released first."""
    hand = Hand()
    assert hand.look(AHEAD) is None
    assert hand.look(AHEAD) is None
    assert hand.deadman.phase is DeadmanPhase.MUST_RELEASE
    hand.drive()


def test_a_pad_that_is_unplugged_ends_it() -> None:
    """After plugging in with the button held, it moves nothing until the button is released."""
    hand = Hand()
    hand.drive()
    assert hand.look(None) is None
    assert (hand.deadman.phase, hand.deadman.ended) == (DeadmanPhase.NO_GAMEPAD, DriveEnd.UNPLUGGED)
    assert hand.look(AHEAD) is None
    assert hand.look(AHEAD) is None
    hand.drive()


@pytest.mark.parametrize("held", [GamepadState(1.0, 0.0, False), GamepadState(0.0, 0.0, True)])
def test_revoked_control_requires_a_full_release(held: GamepadState) -> None:
    """Button and stick; either alone is not enough."""
    hand = Hand()
    hand.drive()
    assert hand.look(AHEAD, allowed=False) is None
    assert hand.deadman.ended is DriveEnd.NOT_ALLOWED
    assert hand.look(AHEAD) is None
    hand.look(held)
    assert hand.look(AHEAD) is None
    hand.drive()


def test_dropped_command_requires_release() -> None:
    """As after a lost connection."""
    hand = Hand()
    hand.drive()
    hand.deadman.require_release()
    assert hand.look(AHEAD) is None
    hand.drive()


def test_pressed_where_it_is_not_allowed_it_begins_nothing_later() -> None:
    """Even if it becomes allowed meanwhile."""
    hand = Hand()
    hand.look(LOOSE)
    assert hand.look(AHEAD, allowed=False) is None
    assert hand.look(AHEAD) is None
    assert hand.deadman.phase is DeadmanPhase.MUST_RELEASE


def test_a_program_that_stood_still_does_not_go_on_with_what_was_held() -> None:
    """Inputs during the stall are unknown."""
    hand = Hand()
    hand.drive()
    assert hand.look(AHEAD, seconds=FROZEN_SECONDS + 0.1) is None
    assert hand.deadman.ended is DriveEnd.FROZEN
    assert hand.look(AHEAD) is None
    hand.drive()
