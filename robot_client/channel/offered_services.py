"""Services and actions that clients of the relay advertise in the robot's graph, on one channel."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count
from typing import NamedTuple

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import MIB
from robot_client.channel.handler import (
    MAX_OPEN,
    ChannelHandler,
    ChannelWriter,
    RequestRejected,
    check_room,
    decode_cdr,
)
from robot_client.platforms.base import ABORTED, SUCCEEDED, AdvertisementHandle, Platform, ServedGoal

PENDING_BYTES = 32 * MIB
"""Most bytes of requests that wait for a client's response."""


class _OfferedByName:
    """The advertisements of one kind, by name.

    :param kind: singular, for errors and the log
    """

    def __init__(self, kind: str, log: Logger) -> None:
        self._kind = kind
        self._log = log
        self._open: dict[str, AdvertisementHandle] = {}

    def add(self, name: str, source: str, advertise: Callable[[], AdvertisementHandle]) -> str:
        """Add an advertisement; returns its full type.

        :param source: name of the client, may be empty
        :raises SwitchboardError: it can't be advertised
        """
        if name in self._open:
            raise RequestRejected(f"this channel advertises the {self._kind} {name} already")
        check_room(self._open, f"{self._kind}s")
        handle = self._open[name] = advertise()
        self._log.info(
            "{client} advertises the {kind} {name}", client=source or "a client", kind=self._kind, name=name
        )
        return handle.type

    def type(self, name: str) -> str:
        """Full type of an advertisement."""
        return self._open[name].type

    def remove(self, name: str) -> None:
        """Withdraw an advertisement if it exists."""
        handle = self._open.pop(name, None)
        if handle is not None:
            handle.close()

    def close(self) -> None:
        """Withdraw all."""
        for handle in self._open.values():
            handle.close()
        self._open.clear()


class _PendingReply(NamedTuple):
    service: str
    respond: Callable[[bytes], None]
    size: int


class AdvertisedServices(ChannelHandler):
    """Services of this channel. ROS has no response for a failed call, so failures are only logged."""

    def __init__(self, writer: ChannelWriter, platform: Platform, frame_limit: int) -> None:
        super().__init__(writer, platform, frame_limit)
        self._offered = _OfferedByName("service", self._log)
        self._calls: dict[str, _PendingReply] = {}
        self._pending_bytes = 0
        self._ids = count(1)

    @property
    def is_busy(self) -> bool:
        """Whether calls wait for their response."""
        return bool(self._calls)

    def advertise(self, message: link.AdvertiseService) -> None:
        """Advertise a service.

        :raises SwitchboardError: it can't be advertised
        """
        service = message.service
        on_call = partial(self._called, service)
        type = self._offered.add(
            service,
            message.user,
            lambda: self._platform.advertise_service(service, message.type, on_call),
        )
        self._writer.send(link.AdvertisedService(service=service, type=type))

    def withdraw(self, message: link.UnadvertiseService) -> None:
        """Withdraw a service; its open calls get no response."""
        for id, call in list(self._calls.items()):
            if call.service == message.service:
                self._pop(id)
        self._offered.remove(message.service)

    def respond(self, message: link.ServiceResponse) -> None:
        """Pass a client's response on; ignored if the call is no longer open."""
        call = self._pop(message.id)
        if call is None:
            return
        if not message.result:
            self._log_failure(call.service, message.reason or "the client gave no reason")
            return
        try:
            call.respond(decode_cdr(message.cdr, call.service))
        except SwitchboardError as error:
            self._log_failure(call.service, str(error))

    def close(self) -> None:
        """Withdraw all services."""
        self._offered.close()
        self._calls.clear()
        self._pending_bytes = 0

    def _called(self, service: str, body: bytes, respond: Callable[[bytes], None]) -> None:
        if len(self._calls) >= MAX_OPEN or self._pending_bytes + len(body) > PENDING_BYTES:
            self._log_failure(service, f"{len(self._calls)} calls wait for their responses already")
            return
        try:
            cdr = self._encode_cdr(body, f"a request to {service}")
        except SwitchboardError as error:
            self._log_failure(service, str(error))
            return
        id = f"s{next(self._ids)}"
        self._calls[id] = _PendingReply(service, respond, len(body))
        self._pending_bytes += len(body)
        type = self._offered.type(service)
        self._writer.send(link.CallService(id=id, service=service, type=type, cdr=cdr))

    def _pop(self, id: str) -> _PendingReply | None:
        call = self._calls.pop(id, None)
        if call is not None:
            self._pending_bytes -= call.size
        return call

    def _log_failure(self, service: str, reason: str) -> None:
        self._log.warn(
            "a call of {service} gets no response: {reason}", service=service, reason=reason, limited="call"
        )


class _ExecutedGoal(NamedTuple):
    action: str
    goal: ServedGoal


class AdvertisedActions(ChannelHandler):
    """Actions of this channel, and the goals that nodes of the robot sent to them."""

    def __init__(self, writer: ChannelWriter, platform: Platform, frame_limit: int) -> None:
        super().__init__(writer, platform, frame_limit)
        self._offered = _OfferedByName("action", self._log)
        self._goals: dict[str, _ExecutedGoal] = {}
        self._ids: dict[ServedGoal, str] = {}
        self._next_id = count(1)

    @property
    def is_busy(self) -> bool:
        """Whether goals are open."""
        return bool(self._goals)

    def advertise(self, message: link.AdvertiseAction) -> None:
        """Advertise an action.

        :raises SwitchboardError: it can't be advertised
        """
        action = message.action
        on_goal = partial(self._goal_received, action)
        type = self._offered.add(
            action,
            message.user,
            lambda: self._platform.advertise_action(action, message.type, on_goal, self._cancel_requested),
        )
        self._writer.send(link.AdvertisedAction(action=action, type=type))

    def withdraw(self, message: link.UnadvertiseAction) -> None:
        """Withdraw an action; its goals are aborted."""
        for id, executed in list(self._goals.items()):
            if executed.action == message.action:
                self._pop(id)
        self._offered.remove(message.action)

    def feedback(self, message: link.ActionFeedback) -> None:
        """Publish feedback of a goal; ignored if the goal has ended."""
        executed = self._goals.get(message.id)
        if executed is None:
            return
        try:
            executed.goal.feedback(decode_cdr(message.cdr, f"feedback of {executed.action}"))
        except SwitchboardError as error:
            self._log.warn(
                "feedback of {action} is dropped: {reason}",
                action=executed.action,
                reason=str(error),
                limited="feedback",
            )

    def result(self, message: link.ActionResult) -> None:
        """End a goal."""
        executed = self._pop(message.id)
        if executed is None:
            return
        action, goal = executed
        try:
            if message.result:
                goal.finish(message.status, decode_cdr(message.cdr, f"the result of {action}"))
                return
            reason = message.reason or "the client gave no reason"
        except SwitchboardError as error:
            reason = str(error)
        self._log.warn(
            "a goal of {action} ends without a result: {reason}",
            action=action,
            reason=reason,
            limited="result",
        )
        # Without a result a goal can't have succeeded.
        goal.finish(ABORTED if message.status == SUCCEEDED else message.status, None)

    def close(self) -> None:
        """Withdraw all actions; all goals are aborted."""
        self._goals.clear()
        self._ids.clear()
        self._offered.close()

    def _goal_received(self, action: str, body: bytes, goal: ServedGoal) -> None:
        try:
            check_room(self._goals, "goals")
            cdr = self._encode_cdr(body, f"a goal for {action}")
        except SwitchboardError as error:
            self._log.warn(
                "a goal of {action} is aborted: {reason}", action=action, reason=str(error), limited="goal"
            )
            goal.finish(ABORTED, None)
            return
        id = f"g{next(self._next_id)}"
        self._goals[id] = _ExecutedGoal(action, goal)
        self._ids[goal] = id
        type = self._offered.type(action)
        self._writer.send(link.SendActionGoal(id=id, action=action, type=type, feedback=True, cdr=cdr))

    def _cancel_requested(self, goal: ServedGoal) -> None:
        id = self._ids.get(goal)
        if id is not None:
            self._writer.send(link.CancelActionGoal(id=id))

    def _pop(self, id: str) -> _ExecutedGoal | None:
        executed = self._goals.pop(id, None)
        if executed is not None:
            del self._ids[executed.goal]
        return executed
