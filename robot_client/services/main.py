"""The command ``switchboard-robot-service``."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from relay_protocol.command_output import OutputGroup
from relay_protocol.errors import SwitchboardError
from relay_protocol.text import escape_unprintable
from robot_client.command_line import Number, examples
from robot_client.offload.device import Where
from robot_client.services.gps_source import BAUDS, source_factory


def camera_model_options(function: Any) -> Any:
    """Options of a camera model."""
    info = click.option(
        "--info",
        default="",
        metavar="TOPIC",
        help="Topic of its CameraInfo. Default: camera_info in the namespace of the images.",
    )
    view = click.option(
        "--view",
        type=Number(1, 170),
        metavar="DEG",
        help="Horizontal field of view, for cameras without a CameraInfo.",
    )
    return info(view(function))


def camera_options(function: Any) -> Any:
    """Options of a camera."""
    image = click.option(
        "--image",
        default="/camera/image_raw",
        show_default=True,
        metavar="TOPIC",
        help="Topic of the images.",
    )
    compressed = click.option(
        "--compressed", is_flag=True, help="The images are of type CompressedImage (JPEG or PNG)."
    )
    return image(compressed(camera_model_options(function)))


if TYPE_CHECKING:
    from robot_client.services.images import ImageRequest

COMMAND = "switchboard-robot-service"


@click.group(
    cls=OutputGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples(f"{COMMAND} obstacles --scan /scan", f"{COMMAND} battery --topic /battery_state"),
)
@click.version_option(package_name="robot-switchboard", message="%(version)s")
def main() -> None:
    """Run one service of a robot, a node in its ROS 2 graph.

    Each prints READY when its topics exist, reports its state on /diagnostics, and ends on SIGINT or SIGTERM.
    """
    # Files created here are private, whatever the umask was.
    os.umask(0o077)


def service(*lines: str) -> Callable[[Callable[..., None]], click.Command]:
    """Make a function a subcommand, with the common options.

    :param lines: examples, without the name of the command
    """

    def make(function: Callable[..., None]) -> click.Command:
        shown = examples(*(f"{COMMAND} {function.__name__} {line}".rstrip() for line in lines))
        namespace = click.option(
            "--namespace",
            default="",
            metavar="NS",
            help="Namespace of the node and its topics.",
        )
        return main.command(function.__name__, epilog=shown)(namespace(_errors_as_click(function)))

    return make


def _errors_as_click(function: Callable[..., None]) -> Callable[..., None]:
    """Turn errors and missing packages into an error message and exit code 1."""

    @functools.wraps(function)
    def run(*args: Any, **options: Any) -> None:
        try:
            import rclpy  # noqa: F401  # checks that it is installed
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
            raise click.ClickException(escape_unprintable(str(error))) from None

    return run


def _image_request(topic: str, compressed: bool, info: str, view: float | None) -> ImageRequest:
    from robot_client.services.images import ImageRequest

    return ImageRequest(topic, compressed, info, view or 0.0)


@service(
    "",
    "--near 0.8 --sectors 8",
    "--depth /camera/depth/image_rect_raw --sectors 5 --height 0.3",
)
@click.option("--scan", default="/scan", show_default=True, metavar="TOPIC", help="Topic of type LaserScan.")
@click.option(
    "--depth", default="", metavar="TOPIC", help="Topic of a depth image (16UC1, 32FC1), instead of a scan."
)
@camera_model_options
@click.option(
    "--sectors",
    type=click.IntRange(1, 360),
    default=12,
    show_default=True,
    help="Number of directions.",
)
@click.option(
    "--near",
    type=Number(0.01, 100),
    default=0.5,
    show_default=True,
    metavar="M",
    help="Distance from the sensor below which obstacles/near is true.",
)
@click.option(
    "--height",
    type=Number(0, 10),
    default=0.2,
    show_default=True,
    metavar="M",
    help="Height of the camera above the floor.",
)
@click.option(
    "--low",
    type=Number(0, 10),
    default=0.05,
    show_default=True,
    metavar="M",
    help="Objects lower than this are no obstacles (depth only).",
)
@click.option(
    "--high",
    type=Number(0, 10),
    default=1.5,
    show_default=True,
    metavar="M",
    help="Objects higher than this are no obstacles (depth only).",
)
@click.option("--frame", default="", help="Frame of the output, x ahead, y left. Default: the sensor's.")
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
    """Publish the nearest obstacle in each direction.

    Topics out: obstacles (LaserScan, a ray for each sector), obstacles/places (PoseArray, the nearest first),
    obstacles/near (Bool).
    """
    from robot_client.services.node_runner import run
    from robot_client.services.obstacles import Band
    from robot_client.services.obstacles_node import Obstacles, ObstacleSettings

    if low >= high:
        raise click.BadParameter(f"--low ({low:g}) must be less than --high ({high:g})")
    source = _image_request(depth, False, info, view) if depth else scan
    settings = ObstacleSettings(sectors, near, frame)
    band = Band(height, low, high)
    run("obstacles", namespace, lambda node: Obstacles(node, source, settings, band))


@service("", "--topic /battery_state --low 30 --critical 15", "--folder /sys/class/power_supply/BAT1")
@click.option(
    "--topic", default="", metavar="TOPIC", help="Check a BatteryState that another node publishes."
)
@click.option(
    "--folder",
    type=click.Path(path_type=Path),
    default="/sys/class/power_supply",
    show_default=True,
    help="Folder of the power supplies, or of one battery, in Linux.",
)
@click.option(
    "--low",
    type=Number(0, 100),
    default=20.0,
    show_default=True,
    metavar="PERCENT",
    help="WARN below this charge.",
)
@click.option(
    "--critical",
    type=Number(0, 100),
    default=10.0,
    show_default=True,
    metavar="PERCENT",
    help="ERROR below this charge.",
)
@click.option(
    "--volts",
    nargs=2,
    type=Number(),
    default=(0.0, 0.0),
    metavar="EMPTY FULL",
    help="Voltages, for batteries that report no charge.",
)
@click.option(
    "--period",
    type=Number(0.1, 3600),
    default=5.0,
    show_default=True,
    metavar="S",
    help="Time between two readings.",
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
    """Publish the state of this machine's battery, or check a battery that another node publishes (--topic).

    A low battery is WARN or ERROR on /diagnostics.

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
    help="Baud rate of a serial device.",
)
@click.option("--frame", default="gps", show_default=True, help="Frame of the antenna.")
@click.option(
    "--pace",
    type=Number(0, 60),
    default=1.0,
    show_default=True,
    metavar="S",
    help="Time between two positions of a file.",
)
def gps(namespace: str, source: str, baud: str, frame: str, pace: float) -> None:
    """Publish the positions of an NMEA 0183 receiver.

    SOURCE is a serial device, tcp://HOST:PORT or a recorded file. Topics out: fix (NavSatFix).
    """
    from robot_client.services.gps_node import Gps
    from robot_client.services.node_runner import run

    open_source = source_factory(source, int(baud), pace)
    run("gps", namespace, lambda node: Gps(node, source, open_source, frame))


def _where_option(function: Any) -> Any:
    """The option that says where a function runs."""
    return click.option(
        "--where",
        type=click.Choice(["auto", "here", "cloud"]),
        default="auto",
        show_default=True,
        help="Where images are searched: auto by the robot's settings and the state of its computer, always here, "
        "or by the relay's workers as long as they answer.",
    )(function)


@service(
    "--size 0.16",
    "--size 0.16 --view 75",
    "--size 0.1 --dictionary APRILTAG_36h11 --image /front/image_raw/compressed --compressed",
)
@camera_options
@click.option(
    "--size",
    type=Number(0.001, 100),
    required=True,
    metavar="M",
    help="Side of the markers' black square.",
)
@click.option("--dictionary", default="4X4_50", show_default=True, help="Marker dictionary of OpenCV.")
@_where_option
def markers(
    namespace: str,
    image: str,
    compressed: bool,
    info: str,
    view: float | None,
    size: float,
    dictionary: str,
    where: Where,
) -> None:
    """Publish the ArUco markers a camera sees, with their poses.

    Topics out: markers (MarkerArray, id is the marker's), markers/seen (String: JSON with id, distance, bearing).
    """
    from robot_client.services.markers import DICTIONARIES
    from robot_client.services.markers_node import Markers
    from robot_client.services.node_runner import run
    from robot_client.services.placement import RunOptions

    if dictionary not in DICTIONARIES:
        raise click.BadParameter(f"'{dictionary}' is not a dictionary; known are: {', '.join(DICTIONARIES)}")
    request = _image_request(image, compressed, info, view)
    run("markers", namespace, lambda node: Markers(node, request, dictionary, size, RunOptions(where)))


@service("--people people/", "--people people/ --view 75 --rate 2")
@camera_options
@click.option(
    "--people",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Images of known persons: for each, one file or one folder, named after the person.",
)
@click.option(
    "--similarity",
    type=Number(0, 1),
    default=0.7,
    show_default=True,
    help="Least similarity of a recognised face.",
)
@click.option(
    "--rate",
    type=Number(0.1, 30),
    default=5.0,
    show_default=True,
    help="Most images per second that are processed.",
)
@_where_option
def faces(
    namespace: str,
    image: str,
    compressed: bool,
    info: str,
    view: float | None,
    people: Path | None,
    similarity: float,
    rate: float,
    where: Where,
) -> None:
    """Publish the faces a camera sees, with positions and names.

    Topics out: faces (MarkerArray), faces/seen (String: JSON with name, distance, bearing).
    """
    from robot_client.services.faces import FaceFinder, KnownFaces, read_people
    from robot_client.services.faces_node import Faces
    from robot_client.services.node_runner import run
    from robot_client.services.placement import RunOptions

    finder = FaceFinder()
    known = read_people(people, finder, similarity) if people else KnownFaces(similarity)
    request = _image_request(image, compressed, info, view)
    run("faces", namespace, lambda node: Faces(node, request, finder, known, rate, RunOptions(where)))


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
    help="Write all sound to this WAV file instead of playing it; an existing file is replaced.",
)
def speech(namespace: str, voice: str, speed: int, volume: int, out: Path | None) -> None:
    """Speak the texts of the topic say (String), one after the other.

    Topics out: speaking (Bool), said (String: each text that was spoken completely). Service: say/cancel (Trigger),
    which stops the speech and drops waiting texts.
    """
    from robot_client.services.node_runner import run
    from robot_client.services.speech import Espeak, WavFile, player
    from robot_client.services.speech_node import Speech

    synthesizer = Espeak(voice, speed, volume)
    output = WavFile(out, synthesizer.rate) if out else player()
    run("speech", namespace, lambda node: Speech(node, synthesizer, output))


@service("", "--radius 0.25 --max-speed 0.3", "--scan /front/scan --depth ''")
@click.option(
    "--scan", default="/scan", show_default=True, metavar="TOPIC", help="LaserScan; empty for none."
)
@click.option(
    "--depth",
    default="/camera/depth/image_rect_raw",
    show_default=True,
    metavar="TOPIC",
    help="Depth image (16UC1, 32FC1) of a level camera; empty for none.",
)
@click.option(
    "--info",
    default="",
    metavar="TOPIC",
    help="Its CameraInfo. Default: camera_info in the namespace of the images.",
)
@click.option(
    "--shortest-depth",
    type=Number(0, 2),
    default=0.5,
    show_default=True,
    metavar="M",
    help="Shortest range of the depth camera: nothing nearer is cleared by pixels without a measurement.",
)
@click.option("--map", "map_topic", default="/map", show_default=True, metavar="TOPIC", help="OccupancyGrid.")
@click.option(
    "--base-frame", default="base_link", show_default=True, metavar="FRAME", help="The robot's frame."
)
@click.option(
    "--localiser-timeout",
    type=Number(0.3, 60),
    default=3.0,
    show_default=True,
    metavar="S",
    help="Seconds that the localiser's transform on /tf may be late; then the robot stands.",
)
@click.option(
    "--radius", type=Number(0.01, 5), default=0.2, show_default=True, metavar="M", help="Radius of the robot."
)
@click.option(
    "--inflation",
    type=Number(0.02, 10),
    default=0.5,
    show_default=True,
    metavar="M",
    help="Distance from obstacles that the robot keeps where there is room.",
)
@click.option(
    "--max-speed", type=Number(0.1, 5), default=0.4, show_default=True, metavar="M/S", help="Maximum speed."
)
@click.option(
    "--max-turn",
    type=Number(0.2, 10),
    default=1.2,
    show_default=True,
    metavar="RAD/S",
    help="Maximum turn rate.",
)
def navigator(
    namespace: str,
    scan: str,
    depth: str,
    info: str,
    shortest_depth: float,
    map_topic: str,
    base_frame: str,
    localiser_timeout: float,
    radius: float,
    inflation: float,
    max_speed: float,
    max_turn: float,
) -> None:
    """Drive to goals around what scanner and depth camera see, with the interface of Nav2.

    Action: navigate_to_pose (nav2_msgs). Topics in: goal_pose (PoseStamped), the map, /tf. Topics out: cmd_vel (Twist),
    plan (Path), local_costmap/costmap and global_costmap/costmap (OccupancyGrid).
    """
    if not (scan or depth):
        raise click.BadParameter("--scan and --depth are both empty; a navigator needs a sensor")
    if inflation < radius:
        raise click.BadParameter(f"--inflation ({inflation:g}) must not be less than --radius ({radius:g})")
    from robot_client.services.node_runner import run

    try:
        from robot_client.navigation.node import NavigatorNode, NavigatorTopics
    except ModuleNotFoundError as error:
        if error.name not in ("nav2_msgs", "tf2_msgs"):
            raise
        raise click.ClickException(
            f"{error.name} is missing; install it, or run 'scripts/setup.sh interfaces'"
        ) from None
    from robot_client.navigation.navigator import NavigatorSettings
    from robot_client.navigation.pursuit import DriveLimits

    info = info or f"{depth.rpartition('/')[0]}/camera_info"
    topics = NavigatorTopics(scan, depth, info, map_topic, base_frame, shortest_depth)
    limits = DriveLimits(max_speed, max_turn)
    settings = NavigatorSettings(topics.sensors(), radius, inflation, limits, localiser_timeout)
    run(
        "navigator",
        namespace,
        lambda node: NavigatorNode(node, topics, settings),
        is_busy=lambda navigator: navigator.busy,
    )


if __name__ == "__main__":
    main()
