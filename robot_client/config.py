"""Settings: defaults, then the TOML file, then ``SWITCHBOARD_ROBOT_<SECTION>_<KEY>`` variables."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from relay_protocol.errors import Invalid
from relay_protocol.limits import COMMAND_DEADLINE_MS, STOP_WITHIN_MS
from relay_protocol.link import MotionPolicy
from robot_client.platforms.definitions import normalise

ENVIRONMENT = "SWITCHBOARD_ROBOT_"
NOT_SETTINGS = frozenset(ENVIRONMENT + name for name in ("STATE", "CONFIG", "LOG_JSON"))
"""Variables that stand for options of the command line."""

MOTION_TYPES = ["geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"]

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+\Z")

_SOURCE = re.compile(r"(v4l2:/dev/.|[a-z]+://.|/.)")

Milliseconds = Annotated[int, msgspec.Meta(ge=50, le=10_000)]


class Safety(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What moves the robot and when it is stopped.

    :param motion_types: message types whose topics move the robot; ``package/Name`` is taken too
    :param motion_topics: further topics that do; a leading ``/`` may be left out
    :param stop_within_ms: time from the last valid command to standing still
    :param deadline_ms: no command older than this is executed
    :param guard: whether a second process stops the robot when the daemon can't
    """

    motion_types: list[str] = msgspec.field(default_factory=lambda: list(MOTION_TYPES))
    motion_topics: list[str] = msgspec.field(default_factory=list)
    stop_within_ms: Milliseconds = STOP_WITHIN_MS
    deadline_ms: Milliseconds = COMMAND_DEADLINE_MS
    guard: bool = True

    def __post_init__(self) -> None:
        # Another spelling of a type or topic would match nothing, and switch the watchdog off in silence.
        msgspec.structs.force_setattr(
            self, "motion_types", [_message_type(each) for each in self.motion_types]
        )
        msgspec.structs.force_setattr(
            self, "motion_topics", [_topic_name("motion_topics", each) for each in self.motion_topics]
        )

    @property
    def policy(self) -> MotionPolicy:
        """As the relay is told."""
        return MotionPolicy(
            types=self.motion_types,
            topics=self.motion_topics,
            deadline_ms=self.deadline_ms,
            stop_within_ms=self.stop_within_ms,
        )


class Ros(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the daemon lives in ROS 2.

    :param executor: ``events`` is cheaper, ``single`` is the older one
    :param graph_hz: how often the graph is looked at
    :param battery: whether the first battery topic is listened to
    :param use_sim_time: whether the robot's time is what ``/clock`` says; what stops the robot goes by the machine's
        own clock in any case
    """

    executor: Literal["events", "single"] = "events"
    graph_hz: Annotated[float, msgspec.Meta(gt=0, le=20)] = 3.0
    battery: bool = True
    use_sim_time: bool = False


class Monitor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How often the relay hears of the robot's health, seconds."""

    health_seconds: Annotated[float, msgspec.Meta(ge=0.1, le=3600)] = 3.0


class Video(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How pictures are shown.

    :param streams: most at a time; each takes a good part of a processor's core
    """

    streams: Annotated[int, msgspec.Meta(ge=1, le=64)] = 8


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All settings; each section is a table of the TOML file.

    :param cameras: those without ROS, by a name like a topic's: ``v4l2:/dev/video0``, an address such as
        ``rtsp://…``, or the path of a file
    """

    safety: Safety = msgspec.field(default_factory=Safety)
    ros: Ros = msgspec.field(default_factory=Ros)
    monitor: Monitor = msgspec.field(default_factory=Monitor)
    video: Video = msgspec.field(default_factory=Video)
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


def _topic_name(where: str, name: str) -> str:
    full = "/" + name.strip().removeprefix("/")
    if not _TOPIC.match(full):
        raise ValueError(f"{where}: '{name}' is no topic; write /name or /namespace/name")
    return full


def _camera_source(name: str, source: str) -> str:
    if not _SOURCE.match(source):
        raise ValueError(
            f"cameras: '{source}' of {name} is none; write v4l2:/dev/video0, rtsp://host/path or /path/of/a/file"
        )
    return source


def load(path: Path | None, environment: Mapping[str, str]) -> Settings:
    """The settings of this run.

    :param path: TOML file, ``None`` for none
    :raises Invalid: the file can't be read, or a key or value is wrong; the text names it
    """
    tables = _from_file(path) if path is not None else {}
    for section, key, value in _from_environment(environment):
        tables.setdefault(section, {})[key] = value
    try:
        return msgspec.convert(tables, Settings, strict=False)
    except msgspec.ValidationError as error:
        raise Invalid(f"the settings are wrong: {error}") from None


def _from_file(path: Path) -> dict[str, dict[str, Any]]:
    try:
        tables = msgspec.toml.decode(path.read_bytes())
    except OSError as error:
        raise Invalid(f"the settings file {path} can't be read: {error.strerror}") from None
    except msgspec.DecodeError as error:
        raise Invalid(f"the settings file {path} is not TOML: {error}") from None
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise Invalid(f"the settings are wrong: '{name}' stands outside of a table such as [safety]")
    return dict(tables)


def _from_environment(environment: Mapping[str, str]) -> list[tuple[str, str, Any]]:
    known = {
        f"{ENVIRONMENT}{section.name}_{key.name}".upper(): (section.name, key.name, key.type)
        for section in msgspec.structs.fields(Settings)
        if section.name != "cameras"  # their names are chosen freely
        for key in msgspec.structs.fields(section.type)
    }
    found = []
    for variable, text in environment.items():
        if not variable.startswith(ENVIRONMENT) or variable in NOT_SETTINGS:
            continue
        if variable not in known:
            raise Invalid(f"the variable {variable} is no setting; there are {', '.join(sorted(known))}")
        section, key, kind = known[variable]
        listed = [each.strip() for each in text.split(",") if each.strip()]
        found.append((section, key, listed if kind == list[str] else text))
    return found
