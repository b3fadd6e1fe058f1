"""Arguments that the applications which drive have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from robot_client.apps.driver import MaximumSpeeds
from robot_client.numbers import Number

AnyCommand = TypeVar("AnyCommand", bound=Callable[..., Any])

USUAL = MaximumSpeeds(0.3, 1.0)
"""What is not too fast for a room."""


def driving(command: AnyCommand) -> AnyCommand:
    """The robot's address, the topic of its commands, and the fastest: ``url``, ``topic``, ``speed``, ``turn``."""
    found: Any = click.argument("url")
    options = [
        click.option(
            "--command", "topic", default="/cmd_vel", show_default=True, help="Topic of the commands."
        ),
        click.option(
            "--speed",
            type=Number(0.01, 10.0),
            default=USUAL.speed,
            show_default=True,
            metavar="M/S",
            help="The fastest it is to drive, within what the robot allows.",
        ),
        click.option(
            "--turn",
            type=Number(0.01, 10.0),
            default=USUAL.turn,
            show_default=True,
            metavar="RAD/S",
            help="The fastest it is to turn, within what the robot allows.",
        ),
    ]
    wrapped: Any = command
    for option in reversed(options):
        wrapped = option(wrapped)
    decorated: AnyCommand = found(wrapped)
    return decorated
