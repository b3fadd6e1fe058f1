"""Settings: defaults, then the TOML file, then ``SWITCHBOARD_ROBOT_<SECTION>_<KEY>`` variables."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from relay_protocol.errors import Invalid
from relay_protocol.limits import (
    COMMAND_DEADLINE_MS,
    LEAST_SAMPLE,
    MIB,
    MOST_SAMPLE,
    ROBOT_SAMPLE,
    STOP_WITHIN_MS,
)
from relay_protocol.link import MotionPolicy, motion
from relay_protocol.wildcards import see_cheap
from robot_client.camera.device import V4L2, read_device
from robot_client.motion.hardware import Switches
from robot_client.motion.safety import Times
from robot_client.platforms.definitions import normalise

ENVIRONMENT = "SWITCHBOARD_ROBOT_"
NOT_SETTINGS = frozenset(ENVIRONMENT + name for name in ("STATE", "CONFIG", "LOG_JSON"))
"""Variables that stand for options of the command line."""

NOT_VARIABLES = frozenset({"topic"})
"""Settings that are tables: they stand in the file alone, as do cameras, whose names are chosen freely."""

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
"""Those of Nav2, and of whoever moves arms, in every namespace."""

GOAL_TOPICS = ["*/goal_pose", "*/goal_update", "*/goals_update"]
"""Those of Nav2, in every namespace: the first gives a goal, the others bend one under way (``GoalUpdater``)."""

_PATTERN = re.compile(r"[/*](?:[A-Za-z0-9_/*?]|\[!?[A-Za-z0-9_-]+\])*\Z")
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+\Z")

_SOURCE = re.compile(r"(v4l2:/dev/.|[a-z]+://.|/.)")

Milliseconds = Annotated[int, msgspec.Meta(ge=50, le=10_000)]
Most = Annotated[float, msgspec.Meta(gt=0, le=1e6)]


class TopicTimes(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Times of one topic, which moves the robot whatever its type.

    :param name: a leading ``/`` may be left out
    :param stop_within_ms: as for the robot, and no longer; ``None``: the same
    :param deadline_ms: as for the robot, and no longer; ``None``: the same
    """

    name: str
    stop_within_ms: Milliseconds | None = None
    deadline_ms: Milliseconds | None = None

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "name", _topic_name("topic", self.name))


class SafetySettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What moves the robot and when it is stopped.

    :param motion_types: message types whose topics move the robot; ``package/Name`` is taken too
    :param motion_topics: further topics that do, by name or by a pattern with ``*``, ``?`` and ``[…]``; a leading ``/``
        may be left out
    :param motion_services: services that do, in the same way
    :param motion_actions: actions that do, in the same way
    :param goal_topics: topics on which one message sends the robot off, in the same way: judged as a goal is, but never
        told zero. What is motion by its type or by ``motion_topics`` is none of them
    :param stop_within_ms: time from the last valid command to standing still
    :param deadline_ms: no command older than this is executed
    :param guard: whether a second process stops the robot when the daemon can't
    :param stop_call: service of the robot that stops its hardware: ``std_srvs/srv/Trigger``, called when somebody stops
        the robot, or ``std_srvs/srv/SetBool``, called with true then, and with false when somebody resumes it; by
        no client
    :param stop_command: program and arguments to run when somebody stops the robot, without a shell
    :param resume_command: the same for when somebody resumes it
    :param ramp_ms: how long what is left moving takes to come to a standstill, within ``stop_within_ms``; 0: none.
        At most 2 s, as the relay gives a robot 3 s to stand before another has control
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
    stop_call: str = ""
    stop_command: list[str] = msgspec.field(default_factory=list)
    resume_command: list[str] = msgspec.field(default_factory=list)
    ramp_ms: Annotated[int, msgspec.Meta(ge=0, le=2_000)] = 0
    topic: list[TopicTimes] = msgspec.field(default_factory=list)

    def __post_init__(self) -> None:
        # Another spelling of a type or topic would match nothing, and switch the watchdog off in silence.
        msgspec.structs.force_setattr(
            self, "motion_types", [_message_type(each) for each in self.motion_types]
        )
        for key in ("motion_topics", "motion_services", "motion_actions", "goal_topics"):
            patterns = [_pattern(key, each) for each in getattr(self, key)]
            msgspec.structs.force_setattr(self, key, patterns)
        if self.stop_call:
            msgspec.structs.force_setattr(self, "stop_call", _topic_name("stop_call", self.stop_call))
        for key in ("stop_command", "resume_command"):
            _check_command(key, getattr(self, key))
        self._check_topics()
        self._check_ramp()

    def _check_topics(self) -> None:
        names = [each.name for each in self.topic]
        for each in self.topic:
            if names.count(each.name) > 1:
                raise ValueError(f"topic: {each.name} stands there twice")
            for key in ("stop_within_ms", "deadline_ms"):
                own, whole = getattr(each, key), getattr(self, key)
                if own is not None and own > whole:
                    raise ValueError(
                        f"topic {each.name}: its {key} ({own}) is longer than the robot's ({whole})"
                    )

    def _check_ramp(self) -> None:
        shortest = min([self.stop_within_ms, *(self.times(each.name).stop_within_ms for each in self.topic)])
        if self.ramp_ms * 2 > shortest:
            # It begins that much earlier: a command that is a little late would brake the robot.
            raise ValueError(
                f"ramp_ms may be at most half of stop_within_ms, which is {shortest}; it is {self.ramp_ms}"
            )

    def times(self, topic: str) -> Times:
        """What holds for a topic."""
        own = next((each for each in self.topic if each.name == topic), TopicTimes(name=topic))
        return Times(own.stop_within_ms or self.stop_within_ms, own.deadline_ms or self.deadline_ms)

    @property
    def policy(self) -> MotionPolicy:
        """As the robot itself goes by, for what is stopped by zero."""
        return MotionPolicy(
            types=self.motion_types,
            topics=list(dict.fromkeys([*self.motion_topics, *(each.name for each in self.topic)])),
            services=self.motion_services,
            actions=self.motion_actions,
            deadline_ms=self.deadline_ms,
            stop_within_ms=self.stop_within_ms,
        )

    @property
    def told(self) -> MotionPolicy:
        """As the relay is told: only who holds control may publish goals."""
        topics = list(dict.fromkeys([*self.policy.topics, *self.goal_topics]))
        return msgspec.structs.replace(self.policy, topics=topics)

    @property
    def switches(self) -> Switches:
        """What stops the hardware."""
        return Switches(self.stop_call, self.stop_command, self.resume_command)


class Speeds(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The most that commands may ask for; ``None`` is without a limit.

    :param linear: metres per second
    :param angular: radians per second
    :param linear_acceleration: metres per second, each second
    :param angular_acceleration: radians per second, each second
    """

    linear: Most | None = None
    angular: Most | None = None
    linear_acceleration: Most | None = None
    angular_acceleration: Most | None = None

    @property
    def whole(self) -> motion.Limits:
        """As the relay is told."""
        return motion.Limits(
            linear=self.linear,
            angular=self.angular,
            linear_acceleration=self.linear_acceleration,
            angular_acceleration=self.angular_acceleration,
        )


class LimitSettings(Speeds, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How fast whom may move the robot; the stricter of what holds for all and for his level counts.

    :param operator: those who may operate the robot
    :param owner: those who own it
    :param unlimited: topics of other types than ``Twist`` and ``TwistStamped`` on which commands pass as they are, by
        name or by a pattern as of ``motion_topics``; on all others those of who is limited are refused
    """

    operator: Speeds = msgspec.field(default_factory=Speeds)
    owner: Speeds = msgspec.field(default_factory=Speeds)
    unlimited: list[str] = msgspec.field(default_factory=list)

    def __post_init__(self) -> None:
        patterns = [_pattern("unlimited", each) for each in self.unlimited]
        msgspec.structs.force_setattr(self, "unlimited", patterns)


class Ros(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the daemon lives in ROS 2.

    :param executor: ``events`` is cheaper, ``single`` is the older one
    :param graph_hz: how often the graph is looked at
    :param battery: whether the first battery topic is listened to
    :param largest_sample_mb: larger messages are not sent, MiB; the relay may take less
    :param use_sim_time: whether the robot's time is what ``/clock`` says; what stops the robot goes by the machine's
        own clock in any case
    """

    executor: Literal["events", "single"] = "events"
    graph_hz: Annotated[float, msgspec.Meta(gt=0, le=20)] = 3.0
    battery: bool = True
    largest_sample_mb: Annotated[int, msgspec.Meta(ge=LEAST_SAMPLE // MIB, le=MOST_SAMPLE // MIB)] = (
        ROBOT_SAMPLE // MIB
    )
    use_sim_time: bool = False


class Monitor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the relay hears of the robot's health.

    :param health_seconds: how often
    :param diagnostics: whether errors on ``/diagnostics`` are told as alerts
    """

    health_seconds: Annotated[float, msgspec.Meta(ge=0.1, le=3600)] = 3.0
    diagnostics: bool = True


class VideoSettingsSection(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How pictures are shown.

    :param streams: most at a time, of which a relay shows no more than 16; each takes a good part of a processor's core
    :param target_ms: delay that pictures stay under, from the camera to the relay's word that they are there: they get
        smaller and fewer for it where the uplink is thin
    """

    streams: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8
    target_ms: Annotated[float, msgspec.Meta(ge=50, le=5000)] = 300.0


class RobotSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All settings; each section is a table of the TOML file.

    :param cameras: those without ROS, by a name like a topic's: ``v4l2:/dev/video0``, which may be told its size, rate
        and format (``v4l2:/dev/video0?width=1280&height=720&fps=30&format=MJPG``), an address such as ``rtsp://…``, or
        the path of a file
    """

    safety: SafetySettings = msgspec.field(default_factory=SafetySettings)
    limits: LimitSettings = msgspec.field(default_factory=LimitSettings)
    ros: Ros = msgspec.field(default_factory=Ros)
    monitor: Monitor = msgspec.field(default_factory=Monitor)
    video: VideoSettingsSection = msgspec.field(default_factory=VideoSettingsSection)
    cameras: dict[str, str] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
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
        raise ValueError(f"{where}: '{name}' matches no name; write /name, or a pattern such as /arm/*")
    try:
        return see_cheap(full)
    except Invalid as error:
        raise ValueError(f"{where}: {error}") from None


def _check_command(where: str, command: list[str]) -> None:
    if command and not command[0].startswith("/"):
        raise ValueError(
            f"{where}: '{command[0]}' must be the whole path of a program, such as /usr/bin/true"
        )


def _topic_name(where: str, name: str) -> str:
    full = "/" + name.strip().removeprefix("/")
    if not _TOPIC.match(full):
        raise ValueError(f"{where}: '{name}' is no topic; write /name or /namespace/name")
    return full


def _camera_source(name: str, source: str) -> str:
    if not _SOURCE.match(source):
        raise ValueError(
            # Not what stands there: it may hold a password.
            f"cameras: what {name} stands for can't be opened; "
            "write v4l2:/dev/video0, rtsp://host/path or /path/of/a/file"
        )
    if source.startswith(V4L2):
        try:
            read_device(source)
        except Invalid as error:
            raise ValueError(f"cameras: of {name}: {error}") from None
    return source


def load(path: Path | None, environment: Mapping[str, str]) -> RobotSettings:
    """The settings of this run.

    :param path: TOML file, ``None`` for none
    :raises Invalid: the file can't be read, or a key or value is wrong; the text names it
    """
    tables = _from_file(path) if path is not None else {}
    for path_of_key, value in _from_environment(environment):
        *sections, key = path_of_key
        _table(tables, sections)[key] = value
    try:
        return msgspec.convert(tables, RobotSettings, strict=False)
    except msgspec.ValidationError as error:
        raise Invalid(f"the settings are wrong: {error}") from None


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
        if not isinstance(table, dict):
            raise Invalid(f"the settings are wrong: '{name}' stands outside of a table such as [safety]")
    return dict(tables)


def _from_environment(environment: Mapping[str, str]) -> list[tuple[tuple[str, ...], Any]]:
    known = {ENVIRONMENT + "_".join(path).upper(): (path, kind) for path, kind in _keys(RobotSettings, ())}
    found = []
    for variable, text in environment.items():
        if not variable.startswith(ENVIRONMENT) or variable in NOT_SETTINGS:
            continue
        if variable not in known:
            raise Invalid(f"the variable {variable} is no setting; there are {', '.join(sorted(known))}")
        path, kind = known[variable]
        listed = [each.strip() for each in text.split(",") if each.strip()]
        found.append((path, listed if kind == list[str] else text))
    return found


def _keys(section: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """All settings that a variable can stand for, with their types."""
    for key in msgspec.structs.fields(section):
        if isinstance(key.type, type) and issubclass(key.type, msgspec.Struct):
            yield from _keys(key.type, (*path, key.name))
        elif path and key.name not in NOT_VARIABLES:
            yield (*path, key.name), key.type
