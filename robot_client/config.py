"""Settings of the robot: defaults, then a TOML file, then variables ``SWITCHBOARD_ROBOT_<SECTION>_<KEY>``."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from relay_protocol.errors import Invalid
from relay_protocol.limits import (
    COMMAND_DEADLINE_MS,
    MAX_SAMPLE,
    MIB,
    MIN_SAMPLE,
    ROBOT_SAMPLE,
    STOP_WITHIN_MS,
)
from relay_protocol.link import MotionPolicy, motion
from relay_protocol.wildcards import check_pattern
from robot_client.camera.device import V4L2, read_device
from robot_client.device_state.settings import DeviceSettings
from robot_client.files.settings import FileGroupSettings, check_groups
from robot_client.modules.settings import ModuleSettings, check_modules, check_readiness
from robot_client.motion.hardware import Switches
from robot_client.motion.watchdog import CommandTimes
from robot_client.platforms.definitions import normalise
from robot_client.platforms.mqtt.settings import MqttSettings

ENVIRONMENT = "SWITCHBOARD_ROBOT_"
NOT_SETTINGS = frozenset(ENVIRONMENT + name for name in ("STATE", "CONFIG", "LOG_JSON"))
"""Variables for command line options."""

TABLES_OF_TABLES = frozenset({"module", "file_group"})
"""Settings of which each is a table of its own, such as ``[[module]]``."""

NOT_VARIABLES = frozenset({"topic"})
"""Settings that are tables, possible only in the file; like cameras, whose names are chosen freely."""

MOTION_TYPES = [
    "geometry_msgs/msg/Twist",
    "geometry_msgs/msg/TwistStamped",
    "sensor_msgs/msg/Joy",
    "trajectory_msgs/msg/JointTrajectory",
    "trajectory_msgs/msg/MultiDOFJointTrajectory",
    "control_msgs/msg/JointJog",
]

MOTION_ACTIONS = [
    "*/navigate_to_pose",
    "*/navigate_through_poses",
    "*/navigate_complete_coverage",
    "*/follow_waypoints",
    "*/follow_gps_waypoints",
    "*/follow_path",
    "*/follow_object",
    "*/drive_on_heading",
    "*/spin",
    "*/backup",
    "*/assisted_teleop",
    "*/dock_robot",
    "*/undock_robot",
    "*/follow_joint_trajectory",
]
"""Actions of Nav2 and of arms, in every namespace."""

GOAL_TOPICS = ["*/goal_pose", "*/goal_update", "*/goals_update"]
"""Goal topics of Nav2, in every namespace: the first starts a goal, the others change an active one
(``GoalUpdater``)."""

_PATTERN = re.compile(r"[/*](?:[A-Za-z0-9_/*?]|\[!?[A-Za-z0-9_-]+\])*\Z")
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+\Z")

_SOURCE = re.compile(r"(v4l2:/dev/.|[a-z]+://.|/.)")

Milliseconds = Annotated[int, msgspec.Meta(ge=50, le=10_000)]
Maximum = Annotated[float, msgspec.Meta(gt=0, le=1e6)]


class TopicTimes(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Times of one motion topic; a topic named here moves the robot whatever its type.

    :param name: a leading ``/`` may be left out
    :param stop_within_ms: at most that of the robot; ``None``: the same
    :param deadline_ms: at most that of the robot; ``None``: the same
    """

    name: str
    stop_within_ms: Milliseconds | None = None
    deadline_ms: Milliseconds | None = None

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "name", _topic_name("topic", self.name))


class SafetySettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Topics, services and actions that move the robot, and when it is stopped.

    :param motion_types: message types whose topics move the robot; ``package/Name`` is accepted too
    :param motion_topics: further topics that move it, by name or by a pattern with ``*``, ``?`` and
        ``[…]``; a leading ``/`` may be left out
    :param motion_services: services that move it, in the same form
    :param motion_actions: actions that move it, in the same form
    :param goal_topics: topics on which one message starts motion, in the same form. Their messages are
        judged like goals, and zero is never published on them. Topics in ``motion_topics`` or of a motion
        type are not goal topics
    :param stop_within_ms: time from the last valid command to standstill
    :param deadline_ms: commands older than this are not executed
    :param guard: whether a second process stops the robot if the daemon can't
    :param stop_service: service of the robot that stops its hardware: ``std_srvs/srv/Trigger``, called at a
        stop, or ``std_srvs/srv/SetBool``, called with true at a stop and with false at a resume. Clients
        can't call it
    :param stop_command: program and arguments to run at a stop, without a shell
    :param resume_command: the same for a resume
    :param ramp_ms: time for a robot without commands to slow down to standstill, within ``stop_within_ms``;
        0: no ramp. At most 2 s, since the relay gives a robot 3 s to stop before another client gets control
    :param topic: topics with shorter times
    """

    motion_types: list[str] = msgspec.field(default_factory=lambda: list(MOTION_TYPES))
    motion_topics: list[str] = msgspec.field(default_factory=list)
    motion_services: list[str] = msgspec.field(default_factory=list)
    motion_actions: list[str] = msgspec.field(default_factory=lambda: list(MOTION_ACTIONS))
    goal_topics: list[str] = msgspec.field(default_factory=lambda: list(GOAL_TOPICS))
    stop_within_ms: Milliseconds = STOP_WITHIN_MS
    deadline_ms: Milliseconds = COMMAND_DEADLINE_MS
    guard: bool = True
    stop_service: str = ""
    stop_command: list[str] = msgspec.field(default_factory=list)
    resume_command: list[str] = msgspec.field(default_factory=list)
    ramp_ms: Annotated[int, msgspec.Meta(ge=0, le=2_000)] = 0
    topic: list[TopicTimes] = msgspec.field(default_factory=list)

    def __post_init__(self) -> None:
        # A misspelt type or topic would match nothing, and its commands would not be supervised.
        msgspec.structs.force_setattr(
            self, "motion_types", [_message_type(each) for each in self.motion_types]
        )
        for key in ("motion_topics", "motion_services", "motion_actions", "goal_topics"):
            patterns = [_pattern(key, each) for each in getattr(self, key)]
            msgspec.structs.force_setattr(self, key, patterns)
        if self.stop_service:
            msgspec.structs.force_setattr(
                self, "stop_service", _topic_name("stop_service", self.stop_service)
            )
        for key in ("stop_command", "resume_command"):
            _check_command(key, getattr(self, key))
        self._check_topics()
        self._check_ramp()

    def _check_topics(self) -> None:
        names = [each.name for each in self.topic]
        for each in self.topic:
            if names.count(each.name) > 1:
                raise ValueError(f"topic: {each.name} is listed twice")
            for key in ("stop_within_ms", "deadline_ms"):
                own, general = getattr(each, key), getattr(self, key)
                if own is not None and own > general:
                    raise ValueError(
                        f"topic {each.name}: its {key} ({own}) is longer than the robot's ({general})"
                    )

    def _check_ramp(self) -> None:
        shortest = min([self.stop_within_ms, *(self.times(each.name).stop_within_ms for each in self.topic)])
        if self.ramp_ms * 2 > shortest:
            # The ramp starts that much earlier, so a slightly late command would brake the robot.
            raise ValueError(
                f"ramp_ms is {self.ramp_ms}; it must be at most half of stop_within_ms, which is {shortest}"
            )

    def times(self, topic: str) -> CommandTimes:
        """The times of a topic."""
        own = next((each for each in self.topic if each.name == topic), TopicTimes(name=topic))
        return CommandTimes(own.stop_within_ms or self.stop_within_ms, own.deadline_ms or self.deadline_ms)

    @property
    def policy(self) -> MotionPolicy:
        """The robot's own policy, for everything that is stopped by zero commands."""
        return MotionPolicy(
            types=self.motion_types,
            topics=list(dict.fromkeys([*self.motion_topics, *(each.name for each in self.topic)])),
            services=self.motion_services,
            actions=self.motion_actions,
            deadline_ms=self.deadline_ms,
            stop_within_ms=self.stop_within_ms,
        )

    @property
    def reported_policy(self) -> MotionPolicy:
        """The policy that the relay receives; with goal topics, since only the controller may publish
        goals."""
        topics = list(dict.fromkeys([*self.policy.topics, *self.goal_topics]))
        return msgspec.structs.replace(self.policy, topics=topics)

    @property
    def switches(self) -> Switches:
        """Switches that stop the hardware."""
        return Switches(self.stop_service, self.stop_command, self.resume_command)


class SpeedSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Highest speeds of commands; ``None``: no limit.

    :param linear: metres per second
    :param angular: radians per second
    :param linear_acceleration: metres per second squared
    :param angular_acceleration: radians per second squared
    """

    linear: Maximum | None = None
    angular: Maximum | None = None
    linear_acceleration: Maximum | None = None
    angular_acceleration: Maximum | None = None

    @property
    def reported(self) -> motion.Limits:
        """The limits that the relay receives."""
        return motion.Limits(
            linear=self.linear,
            angular=self.angular,
            linear_acceleration=self.linear_acceleration,
            angular_acceleration=self.angular_acceleration,
        )


class LimitSettings(SpeedSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Speed limits. The stricter of the general ones and those of the user's level applies.

    :param operator: for users with level operator
    :param owner: for users with level owner
    :param unlimited: topics of other types than ``Twist`` and ``TwistStamped`` on which commands pass
        without limits, in the form of ``motion_topics``; on all other topics of such types, commands of
        limited users are refused
    """

    operator: SpeedSettings = msgspec.field(default_factory=SpeedSettings)
    owner: SpeedSettings = msgspec.field(default_factory=SpeedSettings)
    unlimited: list[str] = msgspec.field(default_factory=list)

    def __post_init__(self) -> None:
        patterns = [_pattern("unlimited", each) for each in self.unlimited]
        msgspec.structs.force_setattr(self, "unlimited", patterns)


class RosSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ROS 2 platform.

    :param executor: ``events`` (less load) or ``single`` (rclpy's older executor)
    :param graph_hz: reads of the graph per second
    :param battery: whether the first battery topic is read
    :param largest_sample_mb: larger messages are not sent, MiB; the relay may accept less
    :param use_sim_time: whether the robot's time is that of ``/clock``; everything that stops the robot
        uses the machine's clock in any case
    """

    executor: Literal["events", "single"] = "events"
    graph_hz: Annotated[float, msgspec.Meta(gt=0, le=20)] = 3.0
    battery: bool = True
    largest_sample_mb: Annotated[int, msgspec.Meta(ge=MIN_SAMPLE // MIB, le=MAX_SAMPLE // MIB)] = (
        ROBOT_SAMPLE // MIB
    )
    use_sim_time: bool = False


class MonitorSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Reports about the robot's health.

    :param health_seconds: seconds between two reports
    :param diagnostics: whether errors on ``/diagnostics`` raise alerts
    """

    health_seconds: Annotated[float, msgspec.Meta(ge=0.1, le=3600)] = 3.0
    diagnostics: bool = True


class VideoSettingsSection(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Camera streams.

    :param max_streams: most streams at a time, up to 16; each uses a good part of a processor core
    :param target_delay_ms: longest delay from a frame's arrival at the robot to its acknowledgement by the relay;
        on a slow uplink frames get smaller and fewer to stay below it
    """

    max_streams: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8
    target_delay_ms: Annotated[float, msgspec.Meta(ge=50, le=5000)] = 300.0


class AssetSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Files of packages that clients may fetch, such as meshes.

    :param roots: directories outside of the packages to which links in their share folders may lead, such as the
        sources of a workspace that was built by ``colcon build --symlink-install``; without them such links are
        refused
    """

    roots: list[str] = msgspec.field(default_factory=list)

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "roots", [_asset_root(each.strip()) for each in self.roots])


class RobotSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All settings; each section is a table of the TOML file.

    :param cameras: sources of cameras without ROS, by a name like a topic's: ``v4l2:/dev/video0``,
        optionally with size, rate and format
        (``v4l2:/dev/video0?width=1280&height=720&fps=30&format=MJPG``), an address such as ``rtsp://…``, or
        the path of a file
    :param module: processes that the daemon supervises
    :param file_group: files that are uploaded to the relay
    :param offload: measurements of the robot's computer, and when they are critical
    :param mqtt: the broker of ``switchboard-mqtt``
    """

    safety: SafetySettings = msgspec.field(default_factory=SafetySettings)
    limits: LimitSettings = msgspec.field(default_factory=LimitSettings)
    ros: RosSettings = msgspec.field(default_factory=RosSettings)
    monitor: MonitorSettings = msgspec.field(default_factory=MonitorSettings)
    video: VideoSettingsSection = msgspec.field(default_factory=VideoSettingsSection)
    assets: AssetSettings = msgspec.field(default_factory=AssetSettings)
    cameras: dict[str, str] = msgspec.field(default_factory=dict)
    module: list[ModuleSettings] = msgspec.field(default_factory=list)
    file_group: list[FileGroupSettings] = msgspec.field(default_factory=list)
    offload: DeviceSettings = msgspec.field(default_factory=DeviceSettings)
    mqtt: MqttSettings = msgspec.field(default_factory=MqttSettings)

    def __post_init__(self) -> None:
        check_modules(self.module)
        check_groups(self.file_group)
        named = {
            _topic_name("cameras", name): _camera_source(name, source)
            for name, source in self.cameras.items()
        }
        msgspec.structs.force_setattr(self, "cameras", named)


def _message_type(name: str) -> str:
    try:
        full = normalise(name.strip())
    except Invalid as error:
        raise ValueError(f"motion_types: {error}") from None
    if "/msg/" not in full:
        raise ValueError(f"motion_types: '{name}' is not a message type; write package/msg/Name")
    return full


def _pattern(where: str, name: str) -> str:
    name = name.strip()
    full = name if name.startswith(("/", "*")) else "/" + name
    plain = not set("*?[") & set(full)
    if not (_TOPIC if plain else _PATTERN).match(full) or full.endswith("/") or "//" in full:
        raise ValueError(f"{where}: '{name}' can't match a name; write /name, or a pattern such as /arm/*")
    try:
        return check_pattern(full)
    except Invalid as error:
        raise ValueError(f"{where}: {error}") from None


def _check_command(where: str, command: list[str]) -> None:
    if command and not command[0].startswith("/"):
        raise ValueError(
            f"{where}: '{command[0]}' must be the absolute path of a program, such as /usr/bin/true"
        )


def _asset_root(path: str) -> str:
    parts = Path(path).parts
    if not path.startswith("/") or len(parts) < 2 or ".." in parts or "\0" in path:
        raise ValueError(
            f"assets: root '{path}' must be the absolute path of a directory without '..', such as /home/robot/ws/src, "
            "and not /"
        )
    return path


def _topic_name(where: str, name: str) -> str:
    full = "/" + name.strip().removeprefix("/")
    if not _TOPIC.match(full):
        raise ValueError(f"{where}: '{name}' is not a topic; write /name or /namespace/name")
    return full


def _camera_source(name: str, source: str) -> str:
    if not _SOURCE.match(source):
        raise ValueError(
            # Without the source itself: it may contain a password.
            f"cameras: the source of {name} is not valid; "
            "write v4l2:/dev/video0, rtsp://host/path or /path/of/a/file"
        )
    if source.startswith(V4L2):
        try:
            read_device(source)
        except Invalid as error:
            raise ValueError(f"cameras: {name}: {error}") from None
    return source


def load(path: Path | None, environment: Mapping[str, str]) -> RobotSettings:
    """Load the settings.

    :param path: TOML file, or ``None``
    :raises Invalid: the file can't be read, or a key or value is wrong; names it
    """
    tables = _from_file(path) if path is not None else {}
    for path_of_key, value in _from_environment(environment):
        *sections, key = path_of_key
        _table(tables, sections)[key] = value
    try:
        settings = msgspec.convert(tables, RobotSettings, strict=False)
        check_readiness(settings.module, environment)
    except ValueError as error:
        raise Invalid(f"the settings are wrong: {error}") from None
    return settings


def _table(tables: dict[str, Any], sections: list[str]) -> dict[str, Any]:
    table = tables
    for section in sections:
        inner = table.setdefault(section, {})
        if not isinstance(inner, dict):
            raise Invalid(f"the settings are wrong: '{section}' must be a table")
        table = inner
    return table


def _from_file(path: Path) -> dict[str, dict[str, Any]]:
    try:
        tables = msgspec.toml.decode(path.read_bytes())
    except OSError as error:
        raise Invalid(f"the settings file {path} can't be read: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise Invalid(f"the settings file {path} is not TOML: {error}") from None
    for name, table in tables.items():
        if not isinstance(table, dict) and name not in TABLES_OF_TABLES:
            raise Invalid(f"the settings are wrong: '{name}' is outside of a table such as [safety]")
    return dict(tables)


def _from_environment(environment: Mapping[str, str]) -> list[tuple[tuple[str, ...], Any]]:
    known = {ENVIRONMENT + "_".join(path).upper(): (path, kind) for path, kind in _keys(RobotSettings, ())}
    found = []
    for variable, text in environment.items():
        if not variable.startswith(ENVIRONMENT) or variable in NOT_SETTINGS:
            continue
        if variable not in known:
            raise Invalid(f"the variable {variable} is not a setting; there are {', '.join(sorted(known))}")
        path, kind = known[variable]
        values = [each.strip() for each in text.split(",") if each.strip()]
        found.append((path, values if kind == list[str] else text))
    return found


def _keys(section: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and type of each setting that has a variable."""
    for key in msgspec.structs.fields(section):
        if isinstance(key.type, type) and issubclass(key.type, msgspec.Struct):
            yield from _keys(key.type, (*path, key.name))
        elif path and key.name not in NOT_VARIABLES:
            yield (*path, key.name), key.type
