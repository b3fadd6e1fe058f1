"""The effects of words in sequence."""

from __future__ import annotations

import pytest

from robot_client.apps.command_words import FACTOR_STEP, INITIAL_FACTOR, MIN_FACTOR, CommandWord, WordCommands
from robot_client.apps.driver import MaximumSpeeds, VelocityCommand

TOP = MaximumSpeeds(0.4, 1.0)


@pytest.mark.parametrize(
    ("word", "command"),
    [
        (CommandWord.AHEAD, VelocityCommand(0.2, 0.0)),
        (CommandWord.BACK, VelocityCommand(-0.2, 0.0)),
        (CommandWord.LEFT, VelocityCommand(0.0, 0.5)),
        (CommandWord.RIGHT, VelocityCommand(0.0, -0.5)),
    ],
)
def test_a_word_moves_the_robot_for_a_moment(word: CommandWord, command: VelocityCommand) -> None:
    """At half of the highest speed at first; then it stands."""
    orders = WordCommands(1.5)
    orders.handle(word, 10.0)
    assert orders.command(TOP, 11.4) == pytest.approx(command)
    assert orders.command(TOP, 11.5) is None


def test_a_word_that_is_repeated_goes_on() -> None:
    """From the latest repetition."""
    orders = WordCommands(1.5)
    orders.handle(CommandWord.AHEAD, 10.0)
    orders.handle(CommandWord.AHEAD, 11.0)
    assert orders.command(TOP, 12.4) is not None
    assert orders.command(TOP, 12.5) is None


def test_another_word_takes_its_place() -> None:
    """There is one motion at a time."""
    orders = WordCommands()
    orders.handle(CommandWord.AHEAD, 10.0)
    orders.handle(CommandWord.LEFT, 10.1)
    assert orders.command(TOP, 10.2) == pytest.approx(VelocityCommand(0.0, 0.5))


def test_faster_and_slower_change_what_is_under_way_and_what_comes() -> None:
    """They also prolong the present motion."""
    orders = WordCommands(1.5)
    orders.handle(CommandWord.AHEAD, 10.0)
    orders.handle(CommandWord.FASTER, 11.0)
    assert orders.command(TOP, 12.4) == pytest.approx(
        VelocityCommand(0.4 * INITIAL_FACTOR * FACTOR_STEP, 0.0)
    )
    assert orders.command(TOP, 12.5) is None
    orders.handle(CommandWord.SLOWER, 13.0)
    orders.handle(CommandWord.SLOWER, 13.0)
    orders.handle(CommandWord.BACK, 13.0)
    assert orders.command(TOP, 13.1) == pytest.approx(
        VelocityCommand(-0.4 * INITIAL_FACTOR / FACTOR_STEP, 0.0)
    )


def test_faster_and_slower_move_nothing_that_stands() -> None:
    """Not even after an earlier motion."""
    orders = WordCommands(1.5)
    orders.handle(CommandWord.FASTER, 10.0)
    assert orders.command(TOP, 10.1) is None
    orders.handle(CommandWord.AHEAD, 11.0)
    orders.handle(CommandWord.FASTER, 13.0)
    assert orders.command(TOP, 13.1) is None


def test_it_never_goes_faster_than_the_fastest_nor_so_slowly_that_nothing_moves() -> None:
    """For any number of repetitions."""
    orders = WordCommands()
    for _ in range(20):
        orders.handle(CommandWord.FASTER, 0.0)
    orders.handle(CommandWord.AHEAD, 0.0)
    assert orders.command(TOP, 0.1) == pytest.approx(VelocityCommand(0.4, 0.0))
    for _ in range(40):
        orders.handle(CommandWord.SLOWER, 0.0)
    assert orders.command(TOP, 0.1) == pytest.approx(VelocityCommand(0.4 * MIN_FACTOR, 0.0))


def test_stop_is_at_once() -> None:
    """A following *faster* moves nothing."""
    orders = WordCommands()
    orders.handle(CommandWord.AHEAD, 0.0)
    orders.handle(CommandWord.STOP, 0.1)
    orders.handle(CommandWord.FASTER, 0.2)
    assert orders.command(TOP, 0.2) is None
