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
from typing import IO, Any, NamedTuple

import click

from relay_protocol.command_output import OutputCommand
from relay_protocol.errors import Invalid
from robot_client.command_line import Number, examples
from robot_client.ros_log import ensure_log_folder

try:
    from robot_client.sim.world import WORLDS
except ModuleNotFoundError as error:
    raise SystemExit(f"switchboard-sim: {error.name} is missing; install the extra 'sim'") from None

_LONGEST_SPIN = 0.1
"""Seconds until a signal is noticed, at most."""
_SMALLEST, _LARGEST = (320, 240), (1920, 1080)
"""Width and height of the camera's image, pixels."""
_RANGE = " to ".join(f"{width}x{height}" for width, height in (_SMALLEST, _LARGEST))


def _size(text: str) -> tuple[int, int]:
    """Width and height from ``1280x720``.

    :raises click.BadParameter: it is something else, or too small or large
    """
    found = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if not found:
        raise click.BadParameter(f"'{text}' is not a size; write width and height in pixels, as 1280x720")
    size = int(found[1]), int(found[2])
    if not all(low <= each <= high for low, each, high in zip(_SMALLEST, size, _LARGEST, strict=True)):
        raise click.BadParameter(f"{text} is out of range: {_RANGE}")
    return size


@click.command(
    cls=OutputCommand,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples(
        "switchboard-sim",
        "switchboard-sim --world open --no-camera --seed 1",
        "switchboard-sim --namespace second --record second.jsonl",
        "switchboard-sim --camera-size 1280x720 --camera-fps 30",
    ),
)
@click.option("--namespace", default="", metavar="NS", help="Namespace of all names, to run several robots.")
@click.option(
    "--record",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Append commands and motion to this file, one JSON object per line.",
)
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the scanner's noise. Default: random.")
@click.option("--world", type=click.Choice(sorted(WORLDS)), default="default", show_default=True)
@click.option(
    "--camera/--no-camera", default=True, help="Publish camera images (drawn only for subscribers)."
)
@click.option(
    "--camera-size",
    type=_size,
    default="640x480",
    show_default=True,
    metavar="WxH",
    help=f"Size of the images in pixels, {_RANGE}.",
)
@click.option(
    "--camera-fps", type=click.IntRange(1, 60), default=15, show_default=True, help="Images per second."
)
@click.option(
    "--depth/--no-depth",
    default=True,
    help="Publish a depth camera's images (measured only for subscribers).",
)
@click.option("--scan/--no-scan", default=True, help="Publish the scanner's measurements.")
@click.option("--battery/--no-battery", default=True, help="Publish the state of the battery.")
@click.option(
    "--command-timeout",
    type=Number(0, 60),
    default=0.0,
    show_default=True,
    metavar="S",
    help="Seconds after which the robot stops without a new command; 0: never.",
)
@click.option(
    "--charge",
    type=Number(0, 100),
    default=100.0,
    show_default=True,
    metavar="PERCENT",
    help="Charge of the battery at the start.",
)
def main(
    namespace: str,
    record: Path | None,
    seed: int | None,
    world: str,
    camera: bool,
    camera_size: tuple[int, int],
    camera_fps: int,
    depth: bool,
    scan: bool,
    battery: bool,
    command_timeout: float,
    charge: float,
) -> None:
    """Run a simulated ROS 2 robot: differential drive, scanner, cameras and battery in a small world.

    In the default world a charger with marker 7 (4X4_50, 0.4 m) is on the wall to the right of the start, and a table
    stands in the east: its plate is at the height of the robot's body, the scanner sees its legs alone.

    Prints READY when its topics exist. SIGINT and SIGTERM end it.
    """
    try:
        import rclpy  # noqa: F401  # checks that it is installed
    except ImportError as error:
        raise click.ClickException(
            f"there is no ROS 2 for this Python ({error}): "
            "source your ROS installation, or install 'robot-switchboard[robot,sim,ros]'"
        ) from None
    # New files are accessible to their owner alone, whatever the umask was.
    os.umask(0o077)
    faulthandler.enable()  # a crash in the middleware's C++ leaves a trace instead of silence
    options = _SimOptions(
        namespace,
        seed,
        world,
        camera_size if camera else None,
        camera_fps,
        depth,
        scan,
        battery,
        command_timeout,
        charge / 100,
    )
    with _opened(record) as stream, _stop_requested() as stop:
        _run(options, stream, stop)


class _SimStopRequested:
    requested = False


class _SimOptions(NamedTuple):
    namespace: str
    seed: int | None
    world: str
    camera_size: tuple[int, int] | None
    camera_fps: int
    depth: bool
    scan: bool
    battery: bool
    command_timeout: float
    charge: float


def _run(options: _SimOptions, stream: IO[bytes] | None, stop: _SimStopRequested) -> None:
    """Run the robot. Imports are in here so that ``--help`` is fast, and works without OpenCV and rclpy."""
    import cv2
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from robot_client.platforms.ros2.errors import check_namespace
    from robot_client.sim.depth_camera import SimDepthCamera
    from robot_client.sim.node import SimNode
    from robot_client.sim.robot import MotionRecorder, SimRobot

    try:
        check_namespace(options.namespace)
    except Invalid as error:
        raise click.BadParameter(str(error)) from None
    cv2.setNumThreads(1)  # images are small: threads would cost more than they save
    place = WORLDS[options.world]()
    robot = SimRobot(place, MotionRecorder(stream), options.seed, time.monotonic, options.charge)
    ensure_log_folder()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = SimNode(
        robot,
        _camera(place, options.camera_size),
        options.camera_fps,
        options.namespace,
        depth_camera=SimDepthCamera(place, options.seed) if options.depth else None,
        scan=options.scan,
        battery=options.battery,
        command_timeout=options.command_timeout,
    )
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


def _camera(world: Any, size: tuple[int, int] | None) -> Any:
    if size is None:
        return None
    from robot_client.sim.camera import SimCamera

    width, height = size
    return SimCamera(world, width, height)


def _executor() -> Any:
    """The events executor if available (a third of the CPU time), else the default one."""
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
        raise click.ClickException(f"cannot write the record {path}: {error.strerror}") from None
    with stream:
        yield stream


@contextlib.contextmanager
def _stop_requested() -> Iterator[_SimStopRequested]:
    """Signals only set a flag; the loop ends at a safe point."""
    stop = _SimStopRequested()

    def request_stop(*_: object) -> None:
        stop.requested = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, request_stop)
    yield stop


if __name__ == "__main__":
    main()
