"""Services and actions that clients of the relay offer to the robot's graph, on one channel."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count
from typing import NamedTuple

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import MIB
from robot_client.channel.parts import MAX_OPEN, ChannelPart, ChannelWriter, NotNow, arguments, check_room
from robot_client.platforms.base import ABORTED, SUCCEEDED, AdvertisementHandle, Platform, ServedGoal

PENDING_BYTES = 32 * MIB
"""Requests that wait for a client's answer, all together."""


class _Advertisements:
    """What a channel offers of one kind, by name.

    :param kind: what one of them is called
    """

    def __init__(self, kind: str, log: Logger) -> None:
        self._kind = kind
        self._log = log
        self._open: dict[str, AdvertisementHandle] = {}

    def begin(self, name: str, source: str, make: Callable[[], AdvertisementHandle]) -> str:
        """Offer one more; its full type.

        :param source: who offers it, may be empty
        :raises SwitchboardError: it can't be offered
        """
        if name in self._open:
            raise NotNow(f"this channel offers the {self._kind} {name} already")
        check_room(self._open, f"{self._kind}s")
        offer = self._open[name] = make()
        self._log.info("{who} offers the {kind} {name}", who=source or "a client", kind=self._kind, name=name)
        return offer.type

    def type(self, name: str) -> str:
        """Full type of one that is offered."""
        return self._open[name].type

    def end(self, name: str) -> None:
        """Offer it no more, if it was."""
        offer = self._open.pop(name, None)
        if offer is not None:
            offer.close()

    def close(self) -> None:
        """Offer nothing more."""
        for offer in self._open.values():
            offer.close()
        self._open.clear()


class _PendingReply(NamedTuple):
    service: str
    answer: Callable[[bytes], None]
    size: int


class OfferedServices(ChannelPart):
    """Services of this channel; ROS has no answer for a call that fails, so that is told to the log alone."""

    def __init__(self, wire: ChannelWriter, platform: Platform, frame_limit: int) -> None:
        super().__init__(wire, platform, frame_limit)
        self._offers = _Advertisements("service", self._log)
        self._calls: dict[str, _PendingReply] = {}
        self._size = 0
        self._ids = count(1)

    def advertise(self, message: link.AdvertiseService) -> None:
        """Offer one.

        :raises SwitchboardError: it can't be offered
        """
        service = message.service
        called = partial(self._called, service)
        type = self._offers.begin(
            service, message.source, lambda: self._platform.serve(service, message.type, called)
        )
        self._wire.say(link.AdvertisedService(service=service, type=type))

    def withdraw(self, message: link.UnadvertiseService) -> None:
        """Offer it no more; its callers get no answer."""
        for id, call in list(self._calls.items()):
            if call.service == message.service:
                self._forget(id)
        self._offers.end(message.service)

    def answer(self, message: link.ServiceResponse) -> None:
        """Pass a client's answer on; one that is too late is passed over."""
        call = self._forget(message.id)
        if call is None:
            return
        if not message.result:
            self._unanswered(call.service, message.reason or "the client gave no reason")
            return
        try:
            call.answer(arguments(message.cdr, call.service))
        except SwitchboardError as error:
            self._unanswered(call.service, str(error))

    def close(self) -> None:
        """Offer nothing more."""
        self._offers.close()
        self._calls.clear()
        self._size = 0

    def _called(self, service: str, body: bytes, answer: Callable[[bytes], None]) -> None:
        if len(self._calls) >= MAX_OPEN or self._size + len(body) > PENDING_BYTES:
            self._unanswered(service, f"{len(self._calls)} calls wait for their answers already")
            return
        try:
            cdr = self._to_cdr(body, f"a request to {service}")
        except SwitchboardError as error:
            self._unanswered(service, str(error))
            return
        id = f"s{next(self._ids)}"
        self._calls[id] = _PendingReply(service, answer, len(body))
        self._size += len(body)
        self._wire.say(link.CallService(id=id, service=service, type=self._offers.type(service), cdr=cdr))

    def _forget(self, id: str) -> _PendingReply | None:
        call = self._calls.pop(id, None)
        if call is not None:
            self._size -= call.size
        return call

    def _unanswered(self, service: str, reason: str) -> None:
        self._log.warn("a call of {service} gets no answer: {reason}", service=service, reason=reason)


class _ExecutedGoal(NamedTuple):
    action: str
    goal: ServedGoal


class OfferedActions(ChannelPart):
    """Actions of this channel, and the goals the graph gave them."""

    def __init__(self, wire: ChannelWriter, platform: Platform, frame_limit: int) -> None:
        super().__init__(wire, platform, frame_limit)
        self._offers = _Advertisements("action", self._log)
        self._goals: dict[str, _ExecutedGoal] = {}
        self._ids: dict[ServedGoal, str] = {}
        self._next = count(1)

    def advertise(self, message: link.AdvertiseAction) -> None:
        """Offer one.

        :raises SwitchboardError: it can't be offered
        """
        action = message.action
        asked = partial(self._asked, action)
        type = self._offers.begin(
            action, message.source, lambda: self._platform.act(action, message.type, asked, self._unwanted)
        )
        self._wire.say(link.AdvertisedAction(action=action, type=type))

    def withdraw(self, message: link.UnadvertiseAction) -> None:
        """Offer it no more; its goals are aborted."""
        for id, pursued in list(self._goals.items()):
            if pursued.action == message.action:
                self._forget(id)
        self._offers.end(message.action)

    def feedback(self, message: link.ActionFeedback) -> None:
        """Publish how far a goal has come."""
        pursued = self._goals.get(message.id)
        if pursued is None:
            return  # it ended while this was on its way
        try:
            pursued.goal.feedback(arguments(message.cdr, f"feedback of {pursued.action}"))
        except SwitchboardError as error:
            self._log.warn("feedback of {action} is left out: {why}", action=pursued.action, why=str(error))

    def result(self, message: link.ActionResult) -> None:
        """End a goal."""
        pursued = self._forget(message.id)
        if pursued is None:
            return
        action, goal = pursued
        try:
            if message.result:
                goal.finish(message.status, arguments(message.cdr, f"the result of {action}"))
                return
            reason = message.reason or "the client gave no reason"
        except SwitchboardError as error:
            reason = str(error)
        self._log.warn("a goal of {action} ends without a result: {reason}", action=action, reason=reason)
        # Nobody can have succeeded without a result.
        goal.finish(ABORTED if message.status == SUCCEEDED else message.status, None)

    def close(self) -> None:
        """Offer nothing more; all goals are aborted."""
        self._goals.clear()
        self._ids.clear()
        self._offers.close()

    def _asked(self, action: str, body: bytes, goal: ServedGoal) -> None:
        try:
            check_room(self._goals, "goals")
            cdr = self._to_cdr(body, f"a goal for {action}")
        except SwitchboardError as error:
            self._log.warn("a goal of {action} is aborted: {reason}", action=action, reason=str(error))
            goal.finish(ABORTED, None)
            return
        id = f"g{next(self._next)}"
        self._goals[id] = _ExecutedGoal(action, goal)
        self._ids[goal] = id
        type = self._offers.type(action)
        self._wire.say(link.SendActionGoal(id=id, action=action, type=type, feedback=True, cdr=cdr))

    def _unwanted(self, goal: ServedGoal) -> None:
        id = self._ids.get(goal)
        if id is not None:
            self._wire.say(link.CancelActionGoal(id=id))

    def _forget(self, id: str) -> _ExecutedGoal | None:
        pursued = self._goals.pop(id, None)
        if pursued is not None:
            del self._ids[pursued.goal]
        return pursued
