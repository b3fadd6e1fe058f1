"""What a gamepad means: the stick's curve, and what the dead man's button lets through."""

from __future__ import annotations

import math

import pytest

from robot_client.apps.deadman import (
    CENTRE,
    FROZEN,
    Curve,
    Deadman,
    DeadmanPhase,
    DriveEnd,
    GamepadState,
    Stick,
)

AHEAD = GamepadState(1.0, 0.0, True)
LOOSE = GamepadState(0.0, 0.0, False)


class Hand:
    """A grip that is looked at again and again."""

    def __init__(self) -> None:
        self.grip = Deadman(Curve(dead=0.1, expo=0.0))
        self.now = 0.0

    def look(self, look: GamepadState | None, allowed: bool = True, seconds: float = 0.02) -> Stick | None:
        self.now += seconds
        return self.grip.look(look, allowed, self.now)

    def drive(self) -> None:
        """Take hold, and push the stick."""
        self.look(LOOSE)
        assert self.look(GamepadState(0.0, 0.0, True)) == CENTRE
        assert self.look(AHEAD) == Stick(1.0, 0.0)


def test_the_middle_of_a_stick_is_nothing_and_its_rim_is_all() -> None:
    """In between it grows from nothing, in every direction."""
    curve = Curve(dead=0.2, expo=0.5)
    assert curve.bend(GamepadState(0.1, -0.1, True)) == CENTRE
    assert curve.bend(GamepadState(0.2, 0.0, True)) == CENTRE
    assert 0 < curve.bend(GamepadState(0.21, 0.0, True)).ahead < 0.01
    assert curve.bend(GamepadState(-1.0, 0.0, True)) == Stick(-1.0, 0.0)
    corner = curve.bend(GamepadState(1.0, 1.0, True))
    assert math.hypot(*corner) == pytest.approx(1.0)


def test_expo_is_gentle_near_the_middle() -> None:
    """And changes nothing at the rim."""
    half = GamepadState(0.5, 0.0, True)
    straight, bent = Curve(dead=0.0, expo=0.0), Curve(dead=0.0, expo=1.0)
    assert straight.bend(half).ahead == pytest.approx(0.5)
    assert bent.bend(half).ahead == pytest.approx(0.125)
    assert bent.bend(AHEAD).ahead == pytest.approx(1.0)


def test_nonsense_is_nothing() -> None:
    """A pad that says no number moves nothing."""
    assert Curve().bend(GamepadState(math.nan, 1.0, True)) == CENTRE
    assert Curve().bend(GamepadState(math.inf, 0.0, True)) == CENTRE


def test_nothing_moves_without_the_button() -> None:
    """However far the stick is."""
    hand = Hand()
    hand.look(LOOSE)
    assert hand.look(GamepadState(1.0, 1.0, False)) is None


def test_driving_begins_with_zero() -> None:
    """Though the stick is pushed already: a robot follows only who has let go."""
    hand = Hand()
    hand.look(LOOSE)
    assert hand.look(AHEAD) == CENTRE
    assert hand.look(AHEAD) == Stick(1.0, 0.0)


def test_the_button_released_ends_it_and_pressed_again_begins_it() -> None:
    """That is letting go by one's own will."""
    hand = Hand()
    hand.drive()
    assert hand.look(GamepadState(1.0, 0.0, False)) is None
    assert (hand.grip.phase, hand.grip.ended) == (DeadmanPhase.READY, DriveEnd.RELEASED)
    hand.drive()


def test_what_was_held_when_the_program_began_counts_for_nothing() -> None:
    """It has to be let go of first."""
    hand = Hand()
    assert hand.look(AHEAD) is None
    assert hand.look(AHEAD) is None
    assert hand.grip.phase is DeadmanPhase.SPENT
    hand.drive()


def test_a_pad_that_is_unplugged_ends_it() -> None:
    """Plugged in again with the button held it moves nothing until that was let go."""
    hand = Hand()
    hand.drive()
    assert hand.look(None) is None
    assert (hand.grip.phase, hand.grip.ended) == (DeadmanPhase.ABSENT, DriveEnd.GONE)
    assert hand.look(AHEAD) is None
    assert hand.look(AHEAD) is None
    hand.drive()


@pytest.mark.parametrize("held", [GamepadState(1.0, 0.0, False), GamepadState(0.0, 0.0, True)])
def test_what_was_taken_away_has_to_be_let_go_of_whole(held: GamepadState) -> None:
    """Button and stick; either alone is not enough."""
    hand = Hand()
    hand.drive()
    assert hand.look(AHEAD, allowed=False) is None
    assert hand.grip.ended is DriveEnd.NOT_ALLOWED
    assert hand.look(AHEAD) is None
    hand.look(held)
    assert hand.look(AHEAD) is None
    hand.drive()


def test_what_is_dropped_has_to_be_let_go_of() -> None:
    """As when the connection was lost."""
    hand = Hand()
    hand.drive()
    hand.grip.drop()
    assert hand.look(AHEAD) is None
    hand.drive()


def test_pressed_where_it_is_not_allowed_it_begins_nothing_later() -> None:
    """Also when it becomes allowed meanwhile."""
    hand = Hand()
    hand.look(LOOSE)
    assert hand.look(AHEAD, allowed=False) is None
    assert hand.look(AHEAD) is None
    assert hand.grip.phase is DeadmanPhase.SPENT


def test_a_program_that_stood_still_does_not_go_on_with_what_was_held() -> None:
    """Nobody knows what was in between."""
    hand = Hand()
    hand.drive()
    assert hand.look(AHEAD, seconds=FROZEN + 0.1) is None
    assert hand.grip.ended is DriveEnd.FROZEN
    assert hand.look(AHEAD) is None
    hand.drive()
