"""What the API answers about alerts, recordings and cameras (SPEC sections 1.8 to 1.10)."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict

from relay_protocol.link import VideoSettings

Severity = Literal["info", "warning", "error"]


class Acknowledged(TypedDict):
    """Who looks after an alert, since when (Unix seconds)."""

    by: str
    at: float


class Alert(TypedDict):
    """What people should know of a robot (SPEC section 1.10).

    :param first: Unix seconds it was told first
    :param last: Unix seconds it was told last
    :param over: Unix seconds, or null while it lasts
    :param news: counts what is worth telling
    :param notify: whether the caller's rules for the portal want it shown
    """

    id: str
    robot: str
    kind: str
    about: str
    level: Severity
    text: str
    first: float
    last: float
    count: int
    state: Literal["open", "over"]
    over: float | None
    acknowledged: Acknowledged | None
    may_acknowledge: bool
    news: int
    notify: bool


class Alerts(TypedDict):
    """A page of alerts, the latest first.

    :param next: what goes on after these as ``before``
    """

    alerts: list[Alert]
    next: str | None


QuietHours = TypedDict("QuietHours", {"from": str, "to": str, "zone": str, "least": str})


class RuleStatus(TypedDict):
    """What was told by a rule.

    :param last: Unix seconds of the last message
    """

    sent: int
    failed: int
    reason: str
    last: float | None


class Rule(TypedDict):
    """A rule by which the caller is told of alerts.

    :param url: as far as its host or scheme
    :param secret: where the relay made it, this once
    """

    id: int
    label: str
    robots: str
    kinds: list[str]
    level: str
    channel: str
    url: str
    over: bool
    group_s: float
    quiet: QuietHours | None
    status: RuleStatus
    secret: NotRequired[str]


class Rules(TypedDict):
    """The caller's rules, and what a rule may say here."""

    rules: list[Rule]
    kinds: list[str]
    levels: list[str]
    channels: list[str]
    schemes: list[str]


class Tested(TypedDict):
    """Whether a message arrived, and why not."""

    ok: bool
    reason: str


# --- recordings and cameras -------------------------------------------------------------------------------


class Recording(TypedDict):
    """A recording.

    :param begun: Unix seconds
    :param ended: Unix seconds
    :param lasted: seconds so far, or in all
    :param megabytes: most that the file may have
    """

    id: str
    robot: str
    user: str
    topics: list[str]
    cameras: list[str]
    begun: float
    ended: float | None
    lasted: float | None
    state: Literal["recording", "finishing", "complete", "incomplete", "recovered"]
    reason: str
    seconds: float
    megabytes: float
    bytes: int
    messages: int
    drops: int
    problems: list[str]


class RecordingPage(TypedDict):
    """A page of recordings, the latest first."""

    recordings: list[Recording]
    next: str | None


class Recordable(TypedDict):
    """What the caller could record now.

    :param denied: why it is nothing
    :param megabytes: what all recordings of the realm may have together
    :param full: why there can't be one more
    """

    topics: list[str]
    cameras: list[str]
    denied: str
    megabytes: float
    left: float
    full: str


class ShownStream(TypedDict):
    """How a camera is shown now."""

    viewers: int
    state: str
    settings: VideoSettings
    playing: dict[str, Any] | None


class Camera(TypedDict):
    """A camera; what it is like is null before somebody watched.

    :param seen: Unix seconds at the robot when it was like this
    """

    name: str
    type: str
    encoding: str | None
    width: int | None
    height: int | None
    fps: float | None
    seen: float | None
    streams: list[ShownStream]


class Cameras(TypedDict):
    """The cameras the caller may view."""

    cameras: list[Camera]
