"""``/api/v1/robots/<robot>/device``: readings of the robot's computer, and which of them are critical."""

from __future__ import annotations

import msgspec

from relay_protocol.errors import Unavailable
from relay_server.http.endpoint import ApiRequest, endpoint
from relay_server.sessions.manager import SessionManager


class DeviceInfo(msgspec.Struct, frozen=True, kw_only=True):
    """State of a robot's computer.

    :param at: when it was measured, Unix time at the robot, seconds
    :param readings: by component: `battery`, `cpu`, `memory` and `disk` in per cent, `temperature` in degrees Celsius,
        `signal` (wireless) in dBm and its `quality`; what can't be read is left out
    :param critical: whether each component is critical
    """

    at: float
    readings: dict[str, float]
    critical: dict[str, bool]


class DeviceEndpoints:
    """Computers of robots."""

    def __init__(self, sessions: SessionManager) -> None:
        self._sessions = sessions

    @endpoint(
        "GET",
        "/api/v1/robots/{robot}/device",
        tag="robots",
        summary="Readings of a robot's computer, and which are critical",
        more="As the robot's device manager measured them last, usually once a minute.",
        returns="the latest readings",
    )
    async def device(self, request: ApiRequest, robot: str) -> DeviceInfo:
        async with self._sessions.admitted(request.principal, robot, request.address) as admission:
            report = admission.robot.device
        if report is None:
            raise Unavailable("the robot is offline, or has not measured its device yet")
        return DeviceInfo(at=report.at, readings=report.readings, critical=report.critical)
