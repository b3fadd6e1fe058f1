"""Arguments that the services which look at pictures have in common."""

from __future__ import annotations

from typing import Any

import click

from robot_client.numbers import Number


def lens(function: Any) -> Any:
    """Options that say how a camera looks at the world."""
    info = click.option(
        "--info",
        default="",
        metavar="TOPIC",
        help="Its CameraInfo. Default: camera_info beside the pictures.",
    )
    view = click.option(
        "--view",
        type=Number(1, 170),
        metavar="DEG",
        help="Degrees from the left edge of its pictures to the right, for cameras without a CameraInfo.",
    )
    return info(view(function))


def camera(function: Any) -> Any:
    """Options that name a camera."""
    image = click.option(
        "--image",
        default="/camera/image_raw",
        show_default=True,
        metavar="TOPIC",
        help="Pictures to look at.",
    )
    compressed = click.option(
        "--compressed", is_flag=True, help="They are of type CompressedImage: JPEG or PNG."
    )
    return image(compressed(lens(function)))
