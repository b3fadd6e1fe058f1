"""What words mean, one after the other."""

from __future__ import annotations

import pytest

from robot_client.apps.driver import Command, Limits
from robot_client.apps.words import FIRST, SLOWEST, STEP, Orders, Word

TOP = Limits(0.4, 1.0)


@pytest.mark.parametrize(
    ("word", "command"),
    [
        (Word.AHEAD, Command(0.2, 0.0)),
        (Word.BACK, Command(-0.2, 0.0)),
        (Word.LEFT, Command(0.0, 0.5)),
        (Word.RIGHT, Command(0.0, -0.5)),
    ],
)
def test_a_word_moves_the_robot_for_a_moment(word: Word, command: Command) -> None:
    """At half of the fastest to begin with; then it stands."""
    orders = Orders(1.5)
    orders.say(word, 10.0)
    assert orders.command(TOP, 11.4) == pytest.approx(command)
    assert orders.command(TOP, 11.5) is None


def test_a_word_that_is_repeated_goes_on() -> None:
    """From when it was said last."""
    orders = Orders(1.5)
    orders.say(Word.AHEAD, 10.0)
    orders.say(Word.AHEAD, 11.0)
    assert orders.command(TOP, 12.4) is not None
    assert orders.command(TOP, 12.5) is None


def test_another_word_takes_its_place() -> None:
    """One thing at a time."""
    orders = Orders()
    orders.say(Word.AHEAD, 10.0)
    orders.say(Word.LEFT, 10.1)
    assert orders.command(TOP, 10.2) == pytest.approx(Command(0.0, 0.5))


def test_faster_and_slower_change_what_is_under_way_and_what_comes() -> None:
    """And have it go on."""
    orders = Orders(1.5)
    orders.say(Word.AHEAD, 10.0)
    orders.say(Word.FASTER, 11.0)
    assert orders.command(TOP, 12.4) == pytest.approx(Command(0.4 * FIRST * STEP, 0.0))
    assert orders.command(TOP, 12.5) is None
    orders.say(Word.SLOWER, 13.0)
    orders.say(Word.SLOWER, 13.0)
    orders.say(Word.BACK, 13.0)
    assert orders.command(TOP, 13.1) == pytest.approx(Command(-0.4 * FIRST / STEP, 0.0))


def test_faster_and_slower_move_nothing_that_stands() -> None:
    """Also not when something was under way before."""
    orders = Orders(1.5)
    orders.say(Word.FASTER, 10.0)
    assert orders.command(TOP, 10.1) is None
    orders.say(Word.AHEAD, 11.0)
    orders.say(Word.FASTER, 13.0)
    assert orders.command(TOP, 13.1) is None


def test_it_never_goes_faster_than_the_fastest_nor_so_slowly_that_nothing_moves() -> None:
    """However often it is said."""
    orders = Orders()
    for _ in range(20):
        orders.say(Word.FASTER, 0.0)
    orders.say(Word.AHEAD, 0.0)
    assert orders.command(TOP, 0.1) == pytest.approx(Command(0.4, 0.0))
    for _ in range(40):
        orders.say(Word.SLOWER, 0.0)
    assert orders.command(TOP, 0.1) == pytest.approx(Command(0.4 * SLOWEST, 0.0))


def test_stop_is_at_once() -> None:
    """And *faster* after it moves nothing."""
    orders = Orders()
    orders.say(Word.AHEAD, 0.0)
    orders.say(Word.STOP, 0.1)
    orders.say(Word.FASTER, 0.2)
    assert orders.command(TOP, 0.2) is None
