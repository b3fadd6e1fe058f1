"""The command ``switchboard-robot-service``."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from relay_protocol.errors import SwitchboardError
from relay_protocol.text import inert
from robot_client.help_text import examples
from robot_client.numbers import Number
from robot_client.services.gps_source import BAUDS, opener
from robot_client.services.options import camera, lens

if TYPE_CHECKING:
    from robot_client.services.pictures import ImageRequest

COMMAND = "switchboard-robot-service"


@click.group(
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples(f"{COMMAND} obstacles --scan /scan", f"{COMMAND} battery --topic /battery_state"),
)
@click.version_option(package_name="robot-switchboard", message="%(version)s")
def main() -> None:
    """Run one service of a robot, a node in its ROS 2 graph.

    Each prints READY when its topics are there, says on /diagnostics how it is, and ends by SIGINT or SIGTERM.
    """
    # Whatever the umask was: what is made here is its owner's alone.
    os.umask(0o077)


def service(*lines: str) -> Callable[[Callable[..., None]], click.Command]:
    """A subcommand of its function's name, with what all have.

    :param lines: examples, without the name of the command
    """

    def make(function: Callable[..., None]) -> click.Command:
        shown = examples(*(f"{COMMAND} {function.__name__} {line}".rstrip() for line in lines))
        namespace = click.option(
            "--namespace",
            default="",
            metavar="NS",
            help="Put before the names of the node and of its topics.",
        )
        return main.command(function.__name__, epilog=shown)(namespace(_in_words(function)))

    return make


def _in_words(function: Callable[..., None]) -> Callable[..., None]:
    """What is missing or goes wrong becomes a sentence on stderr and exit code 1."""

    @functools.wraps(function)
    def run(*args: Any, **options: Any) -> None:
        try:
            import rclpy  # noqa: F401  # only to see that it is there
        except ImportError as error:
            raise click.ClickException(
                f"there is no ROS 2 for this Python ({error}): "
                "source your ROS installation, or install 'robot-switchboard[robot,services,ros]'"
            ) from None
        try:
            function(*args, **options)
        except ModuleNotFoundError as error:
            raise click.ClickException(f"{error.name} is missing; install the extra 'services'") from None
        except SwitchboardError as error:
            raise click.ClickException(inert(str(error))) from None

    return run


def _asked(topic: str, compressed: bool, info: str, view: float | None) -> ImageRequest:
    from robot_client.services.pictures import ImageRequest

    return ImageRequest(topic, compressed, info, view or 0.0)


@service(
    "",
    "--near 0.8 --sectors 8",
    "--depth /camera/depth/image_rect_raw --sectors 5 --height 0.3",
)
@click.option("--scan", default="/scan", show_default=True, metavar="TOPIC", help="Of type LaserScan.")
@click.option(
    "--depth", default="", metavar="TOPIC", help="Depth as Image (16UC1, 32FC1), instead of a scan."
)
@lens
@click.option(
    "--sectors",
    type=click.IntRange(1, 360),
    default=12,
    show_default=True,
    help="Directions that are told apart.",
)
@click.option(
    "--near",
    type=Number(0.01, 100),
    default=0.5,
    show_default=True,
    metavar="M",
    help="Nearer than this to the sensor is too near.",
)
@click.option(
    "--height",
    type=Number(0, 10),
    default=0.2,
    show_default=True,
    metavar="M",
    help="Of the camera.",
)
@click.option(
    "--low",
    type=Number(0, 10),
    default=0.05,
    show_default=True,
    metavar="M",
    help="What is lower over the floor is none (depth).",
)
@click.option(
    "--high",
    type=Number(0, 10),
    default=1.5,
    show_default=True,
    metavar="M",
    help="What is higher is none (depth).",
)
@click.option("--frame", default="", help="Of what it says: x ahead, y left. Default: the sensor's.")
def obstacles(
    namespace: str,
    scan: str,
    depth: str,
    info: str,
    view: float | None,
    sectors: int,
    near: float,
    height: float,
    low: float,
    high: float,
    frame: str,
) -> None:
    """Say what is nearest in each direction.

    Topics out: obstacles (LaserScan, a ray for each sector), obstacles/places (PoseArray, the nearest first),
    obstacles/near (Bool).
    """
    from robot_client.services.node_runner import run
    from robot_client.services.obstacles import Band
    from robot_client.services.obstacles_node import Obstacles, ObstacleSettings

    if low >= high:
        raise click.BadParameter(f"--low ({low:g}) must be less than --high ({high:g})")
    source = _asked(depth, False, info, view) if depth else scan
    settings = ObstacleSettings(sectors, near, frame)
    band = Band(height, low, high)
    run("obstacles", namespace, lambda node: Obstacles(node, source, settings, band))


@service("", "--topic /battery_state --low 30 --critical 15", "--folder /sys/class/power_supply/BAT1")
@click.option(
    "--topic", default="", metavar="TOPIC", help="Judge a BatteryState that another node publishes."
)
@click.option(
    "--folder",
    type=click.Path(path_type=Path),
    default="/sys/class/power_supply",
    show_default=True,
    help="Where Linux tells of the battery; it is published as battery_state.",
)
@click.option(
    "--low",
    type=Number(0, 100),
    default=20.0,
    show_default=True,
    metavar="PERCENT",
    help="WARN below.",
)
@click.option(
    "--critical",
    type=Number(0, 100),
    default=10.0,
    show_default=True,
    metavar="PERCENT",
    help="ERROR below.",
)
@click.option(
    "--volts",
    nargs=2,
    type=Number(),
    default=(0.0, 0.0),
    metavar="EMPTY FULL",
    help="For batteries that tell their voltage alone.",
)
@click.option(
    "--period",
    type=Number(0.1, 3600),
    default=5.0,
    show_default=True,
    metavar="S",
    help="Of readings.",
)
def battery(
    namespace: str,
    topic: str,
    folder: Path,
    low: float,
    critical: float,
    volts: tuple[float, float],
    period: float,
) -> None:
    """Publish the charge of this machine's battery.

    Or judge that of another node, with --topic. On /diagnostics it is WARN and ERROR when it is low.

    Topics out: battery_state (BatteryState; not with --topic).
    """
    from robot_client.services.battery import Gauge
    from robot_client.services.battery_node import SysfsBattery, TopicBattery
    from robot_client.services.node_runner import run

    if critical > low:
        raise click.BadParameter(f"--critical ({critical:g}) must not be more than --low ({low:g})")
    gauge = Gauge(low / 100, critical / 100, volts)
    if topic:
        run("battery", namespace, lambda node: TopicBattery(node, topic, gauge))
    else:
        run("battery", namespace, lambda node: SysfsBattery(node, folder, gauge, period))


@service("/dev/ttyUSB0 --baud 9600", "tcp://192.168.1.30:10110", "drive.nmea --pace 0.2")
@click.argument("source")
@click.option(
    "--baud",
    type=click.Choice([str(each) for each in BAUDS]),
    default="9600",
    show_default=True,
    help="Of a serial device.",
)
@click.option("--frame", default="gps", show_default=True, help="Of the antenna.")
@click.option(
    "--pace",
    type=Number(0, 60),
    default=1.0,
    show_default=True,
    metavar="S",
    help="Between two positions of a file.",
)
def gps(namespace: str, source: str, baud: str, frame: str, pace: float) -> None:
    """Publish the positions a receiver tells in NMEA 0183.

    SOURCE is a serial device, tcp://HOST:PORT or a recorded file. Topics out: fix (NavSatFix).
    """
    from robot_client.services.gps_node import Gps
    from robot_client.services.node_runner import run

    opened = opener(source, int(baud), pace)
    run("gps", namespace, lambda node: Gps(node, source, opened, frame))


@service(
    "--size 0.16",
    "--size 0.16 --view 75",
    "--size 0.1 --dictionary APRILTAG_36h11 --image /front/image_raw/compressed --compressed",
)
@camera
@click.option(
    "--size",
    type=Number(0.001, 100),
    required=True,
    metavar="M",
    help="Side of the markers' black square.",
)
@click.option(
    "--dictionary", default="4X4_50", show_default=True, help="Family of markers, as OpenCV names it."
)
def markers(
    namespace: str,
    image: str,
    compressed: bool,
    info: str,
    view: float | None,
    size: float,
    dictionary: str,
) -> None:
    """Say which ArUco markers a camera sees, and where.

    Topics out: markers (MarkerArray, id is the marker's), markers/seen (String: JSON with id, distance, bearing).
    """
    from robot_client.services.markers import DICTIONARIES
    from robot_client.services.markers_node import Markers
    from robot_client.services.node_runner import run

    if dictionary not in DICTIONARIES:
        raise click.BadParameter(f"'{dictionary}' is not known; these are: {', '.join(DICTIONARIES)}")
    asked = _asked(image, compressed, info, view)
    run("markers", namespace, lambda node: Markers(node, asked, dictionary, size))


@service("--people people/", "--people people/ --view 75 --rate 2")
@camera
@click.option(
    "--people",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Pictures of who is to be recognised: a file or a folder a person, of its name.",
)
@click.option(
    "--alike",
    type=Number(0, 1),
    default=0.7,
    show_default=True,
    help="How alike a face must be to a person's picture.",
)
@click.option(
    "--rate",
    type=Number(0.1, 30),
    default=5.0,
    show_default=True,
    help="Pictures per second that are looked at, at most.",
)
def faces(
    namespace: str,
    image: str,
    compressed: bool,
    info: str,
    view: float | None,
    people: Path | None,
    alike: float,
    rate: float,
) -> None:
    """Say which faces a camera sees, where, and whose they are.

    Topics out: faces (MarkerArray), faces/seen (String: JSON with name, distance, bearing).
    """
    from robot_client.services.faces import Finder, KnownFaces, read_people
    from robot_client.services.faces_node import Faces
    from robot_client.services.node_runner import run

    finder = Finder()
    known = read_people(people, finder, alike) if people else KnownFaces(alike)
    asked = _asked(image, compressed, info, view)
    run("faces", namespace, lambda node: Faces(node, asked, finder, known, rate))


@service("", "--voice de --speed 140", "--out said.wav")
@click.option(
    "--voice", default="en", show_default=True, help="Language or voice of eSpeak NG: en-us, de, cs …"
)
@click.option(
    "--speed",
    type=click.IntRange(80, 450),
    default=160,
    show_default=True,
    metavar="WORDS",
    help="Words per minute.",
)
@click.option("--volume", type=click.IntRange(0, 200), default=100, show_default=True, metavar="PERCENT")
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Write everything into this WAV file instead of playing it; an old one is replaced.",
)
def speech(namespace: str, voice: str, speed: int, volume: int, out: Path | None) -> None:
    """Say what comes on the topic say (String).

    One text after the other, never two at a time. Topics out: speaking (Bool), said (String).
    Service: say/hush (Trigger), which silences it.
    """
    from robot_client.services.espeak import Espeak
    from robot_client.services.node_runner import run
    from robot_client.services.speech import WavFile, player
    from robot_client.services.speech_node import Speech

    speaker = Espeak(voice, speed, volume)
    output = WavFile(out, speaker.rate) if out else player()
    run("speech", namespace, lambda node: Speech(node, speaker, output))


if __name__ == "__main__":
    main()
