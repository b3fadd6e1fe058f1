"""Calls and goals that move the robot: they acquire control of it, and expire like commands."""

from __future__ import annotations

from relay_protocol import nonfinite
from relay_protocol.errors import Refused
from relay_server.channels.members import RequestContext
from relay_server.sessions.context import ClientContext


def call_context(client: ClientContext, service: str, earliest_sent: int, args: bytes) -> RequestContext:
    """The context of a service call; a call that moves the robot acquires control of it.

    :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`
    :param args: JSON
    :raises NotFinite: it moves the robot, and a number is not finite
    :raises Refused: it may be too old, another client has control, or control must be taken first
    """
    moves = client.robot.description.motion.moves_by_service(service)
    motion_request = MotionRequest(client, f"a call of {service}", earliest_sent, args) if moves else None
    return RequestContext(client.number, earliest_sent, motion_request)


def too_old(what: str, age: int, deadline_ms: int) -> str:
    """The error text about a command that was not carried out.

    :param age: nanoseconds, at most
    """
    return (
        f"{what}: it may be {age / 1e6:.0f} ms old, by the last ping answered; "
        f"the robot takes none older than {deadline_ms} ms"
    )


class MotionRequest:
    """A call or goal that moves the robot (:class:`relay_server.channels.members.MotionConditions`).

    :param what: description of the request, for error texts
    :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`
    :param args: JSON of its arguments, which is not kept
    :raises NotFinite: a number in it is not finite
    :raises Refused: it may be too old, another client has control, or control must be taken first
    """

    def __init__(self, client: ClientContext, what: str, earliest_sent: int, args: bytes) -> None:
        self._client = client
        self._what = what
        self._earliest_sent = earliest_sent
        # A request that is too old must not even acquire control.
        self.check_age()
        nonfinite.require_finite(args)
        client.controller.acquire_by_command(client)
        client.motion.last_command = client.motion.last_motion = client.earliest_sent

    async def wait_for_control(self) -> None:
        """Wait until the client controls the robot.

        :raises Refused: as above
        :raises Unavailable: the robot is offline, or does not agree
        """
        self.check_age()
        await self._client.controller.wait_for_control(self._client)

    def check_age(self) -> None:
        """:raises Refused: the request may be too old by now"""
        client = self._client
        age = client.age.now() - self._earliest_sent
        deadline_ms = client.robot.description.motion.deadline_ms
        if age > deadline_ms * 1_000_000:
            client.motion.stale_commands += 1
            raise Refused(too_old(f"{self._what} was refused", age, deadline_ms))
