"""The command `switchboard-sim`."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import click

from relay_protocol.errors import Invalid
from robot_client.help_text import examples
from robot_client.numbers import Number
from robot_client.ros_log import ensure_log_folder

try:
    from robot_client.sim.worlds import WORLDS
except ModuleNotFoundError as error:
    raise SystemExit(f"switchboard-sim: {error.name} is missing; install the extra 'sim'") from None

_LONGEST_SPIN = 0.1
"""Seconds; how long a signal may wait to be seen."""
_SMALLEST, _LARGEST = (320, 240), (1920, 1080)
"""Width and height of the camera's picture, pixels."""
_RANGE = " to ".join(f"{width}x{height}" for width, height in (_SMALLEST, _LARGEST))


def _size(text: str) -> tuple[int, int]:
    """Width and height from ``1280x720``.

    :raises click.BadParameter: it is something else, or too small or large
    """
    found = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if not found:
        raise click.BadParameter(f"'{text}' is no size: write width and height in pixels, as 1280x720")
    size = int(found[1]), int(found[2])
    if not all(low <= each <= high for low, each, high in zip(_SMALLEST, size, _LARGEST, strict=True)):
        raise click.BadParameter(f"{text} is out of range: {_RANGE}")
    return size


@click.command(
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples(
        "switchboard-sim",
        "switchboard-sim --world open --no-camera --seed 1",
        "switchboard-sim --namespace second --record second.jsonl",
        "switchboard-sim --camera-size 1280x720 --camera-fps 30",
    ),
)
@click.option("--namespace", default="", metavar="NS", help="Put before all names, so that several can run.")
@click.option(
    "--record",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Append what the robot was told and did to this file, one JSON object per line.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), help="Seed of the scanner's noise; without it every run differs."
)
@click.option("--world", type=click.Choice(sorted(WORLDS)), default="default", show_default=True)
@click.option("--camera/--no-camera", default=True, help="Offer pictures (drawn only while somebody looks).")
@click.option(
    "--camera-size",
    type=_size,
    default="640x480",
    show_default=True,
    metavar="WxH",
    help=f"Of its pictures, in pixels, {_RANGE}.",
)
@click.option(
    "--camera-fps", type=click.IntRange(1, 60), default=15, show_default=True, help="Pictures per second."
)
@click.option(
    "--charge",
    type=Number(0, 100),
    default=100.0,
    show_default=True,
    metavar="PERCENT",
    help="Of the battery at the beginning.",
)
def main(
    namespace: str,
    record: Path | None,
    seed: int | None,
    world: str,
    camera: bool,
    camera_size: tuple[int, int],
    camera_fps: int,
    charge: float,
) -> None:
    """Run a simulated ROS 2 robot: differential drive, scanner, camera and battery in a small world.

    In the default world a charger with marker 7 (4X4_50, 0.4 m) is on the wall to the right of the start.

    Prints READY when its topics are there. SIGINT and SIGTERM end it.
    """
    try:
        import rclpy  # noqa: F401  # only to see that it is there
    except ImportError as error:
        raise click.ClickException(
            f"there is no ROS 2 for this Python ({error}): "
            "source your ROS installation, or install 'robot-switchboard[robot,sim,ros]'"
        ) from None
    # Whatever the umask was: what is made here is its owner's alone.
    os.umask(0o077)
    faulthandler.enable()  # a crash in the middleware's C++ leaves a trace instead of silence
    with _opened(record) as stream, _stop_requested() as stop:
        _run(namespace, stream, seed, world, camera_size if camera else None, camera_fps, charge / 100, stop)


class _SimStopRequested:
    requested = False


def _run(
    namespace: str,
    stream: IO[bytes] | None,
    seed: int | None,
    world: str,
    size: tuple[int, int] | None,
    fps: int,
    charge: float,
    stop: _SimStopRequested,
) -> None:
    """Imports late: `--help` and a missing ROS must not wait for, or fall over, OpenCV and rclpy."""
    import cv2
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from robot_client.platforms.ros2.errors import check_namespace
    from robot_client.sim.camera import SimCamera
    from robot_client.sim.node import SimNode
    from robot_client.sim.recorder import MotionRecorder
    from robot_client.sim.robot import SimRobot

    try:
        check_namespace(namespace)
    except Invalid as error:
        raise click.BadParameter(str(error)) from None
    cv2.setNumThreads(1)  # pictures are small: threads would cost more than they give
    place = WORLDS[world]()
    robot = SimRobot(place, MotionRecorder(stream), seed, time.monotonic, charge)
    ensure_log_folder()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = SimNode(robot, SimCamera(place, *size) if size else None, fps, namespace)
    executor = _executor()
    executor.add_node(node)
    try:
        pause = node.run_due()
        click.echo("READY")
        while not stop.requested:
            executor.spin_once(timeout_sec=min(pause, _LONGEST_SPIN))
            pause = node.run_due()
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


def _executor() -> Any:
    """The events executor where there is one (it costs a third), else the one every ROS 2 has."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()


@contextlib.contextmanager
def _opened(path: Path | None) -> Iterator[IO[bytes] | None]:
    if path is None:
        yield None
        return
    try:
        stream = path.open("ab")
    except OSError as error:
        raise click.ClickException(f"the record {path} can't be written: {error.strerror}") from None
    with stream:
        yield stream


@contextlib.contextmanager
def _stop_requested() -> Iterator[_SimStopRequested]:
    """Signals only set a mark: the loop ends by itself, at a place where all is in order."""
    stop = _SimStopRequested()

    def note(*_: object) -> None:
        stop.requested = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, note)
    yield stop


if __name__ == "__main__":
    main()
