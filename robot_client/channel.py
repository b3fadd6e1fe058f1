"""One channel: what the relay asks on it becomes actions on the platform, and samples flow back.

Everything a channel opened ends with it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sized
from typing import Any, NamedTuple, Protocol

from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from relay_protocol.frames import SampleFrame
from relay_protocol.limits import CALL_SECONDS, KIB
from robot_client.motion import MOTION_QOS, MotionDesk
from robot_client.offset import Offset
from robot_client.platforms.base import Platform, Sink, Source
from robot_client.reactors import Clock, Timer
from robot_client.topics import TypedTopic
from robot_client.uplink import Uplink

CHUNK = 64 * KIB
MAX_OPEN = 1000
"""Subscriptions, publications and pending calls of each kind on one channel."""


class _Listening(NamedTuple):
    source: Source
    request: link.Subscribe


class _Publishing(NamedTuple):
    sink: Sink
    topic: str
    motion: str | None
    """Name of the publication at the motion desk, if it moves the robot."""


class Wire(Protocol):
    """What a channel needs of its link."""

    def say(self, message: link.Message) -> None:
        """Send a message; it is never dropped."""

    def write(self, frames: list[bytes]) -> None:
        """Send sample frames; may pause the uplink."""


class Channel:
    """The robot's end of one channel.

    :param name: the relay's name for it
    :param offset: clock offset of this very link
    """

    def __init__(
        self,
        name: str,
        wire: Wire,
        offset: Offset,
        platform: Platform,
        motion: MotionDesk,
        clock: Clock,
        frame_limit: int,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        self.name = name
        self.uplink = Uplink(clock.seconds, frame_limit)
        self._wire = wire
        self._offset = offset
        self._platform = platform
        self._motion = motion
        self._clock = clock
        self._wall = wall
        self._listening: dict[int, _Listening] = {}
        self._publishing: dict[int, _Publishing] = {}
        self._calls: dict[str, Deferred[None]] = {}
        self._flush: Timer | None = None
        self._release: Timer | None = None
        self._log = Logger("channel")

    # --- from the relay ------------------------------------------------------------------------------------

    def handle(self, message: link.Message) -> None:
        """Do what one message asks; what can't be done is answered in words."""
        try:
            _HANDLERS[type(message)](self, message)
        except SwitchboardError as error:
            self._fail(message, str(error))
        except Exception:
            # A middleware that throws something unforeseen must not cost the other users their channel.
            self._log.failure("a request on channel {channel} failed", channel=self.name)
            self._fail(message, "the robot could not do this; its log says why")

    def sample(self, frame: SampleFrame) -> None:
        """Publish one message, if it may still be published."""
        publishing = self._publishing.get(frame.number)
        if publishing is None:
            return  # refused or unadvertised while this was on its way
        try:
            if publishing.motion is not None:
                self._motion.command(publishing.motion, frame.body, frame.stamp, self._offset)
            else:
                publishing.sink.publish(frame.body)
        except Exception as error:
            self._log.error("could not publish on {topic}: {error}", topic=publishing.topic, error=str(error))

    def close(self) -> None:
        """The link is gone: stop what moves, release all."""
        for number in list(self._publishing):
            self._unpublish(number)
        for number in list(self._listening):
            self._unlisten(number)
        for call in list(self._calls.values()):
            call.cancel()
        for timer in (self._flush, self._release):
            if timer is not None and timer.active():
                timer.cancel()

    # --- requests ------------------------------------------------------------------------------------------

    def _subscribe(self, message: link.Subscribe) -> None:
        known = self._listening.get(message.number)
        if known is not None:
            self.uplink.open(message.number, message.throttle_ms / 1000, known.source.latched)
            self._listening[message.number] = _Listening(known.source, message)
            self._confirm(message.number)
            self._arm_release()
            return
        _check_room(self._listening, "subscriptions")
        number = message.number
        source = self._platform.subscribe(
            message.topic,
            message.type,
            message.qos,
            lambda body: self._sampled(number, body),
            lambda: self._confirm(number),
        )
        self._listening[number] = _Listening(source, message)
        self.uplink.open(number, message.throttle_ms / 1000, source.latched)
        self._confirm(number)

    def _confirm(self, number: int) -> None:
        listening = self._listening.get(number)
        if listening is None:
            return
        source, request = listening
        self.uplink.open(number, request.throttle_ms / 1000, source.latched)
        self._wire.say(
            link.Subscribed(
                number=number,
                topic=request.topic,
                type=source.type,
                encoding=self._platform.encoding,
                latched=source.latched,
                publishers=source.publishers,
            )
        )

    def _unsubscribe(self, message: link.Unsubscribe) -> None:
        self._unlisten(message.number)

    def _unlisten(self, number: int) -> None:
        listening = self._listening.pop(number, None)
        if listening is not None:
            listening.source.close()
            self.uplink.close(number)

    def _advertise(self, message: link.Advertise) -> None:
        number = message.number
        if number in self._publishing:
            self._unpublish(number)
        _check_room(self._publishing, "publications")
        # What moves is judged by the names that are used in the end: the relay may spell them as it likes.
        on = self._platform.resolve(message.topic, message.type)
        if self._motion.concerns(on):
            self._publishing[number] = publishing = self._advertise_motion(number, on)
            self._log.info("{who} may drive by {topic}", who=message.source or "a client", topic=on.topic)
        else:
            sink = self._platform.advertise(*on, message.latch, message.qos)
            self._publishing[number] = publishing = _Publishing(sink, on.topic, None)
        self._wire.say(
            link.Advertised(
                number=number,
                topic=message.topic,
                type=on.type,
                encoding=self._platform.encoding,
                motion=publishing.motion is not None,
            )
        )

    def _advertise_motion(self, number: int, on: TypedTopic) -> _Publishing:
        name = f"{self.name}/{number}"
        sink = self._platform.advertise(*on, False, MOTION_QOS)
        try:
            self._motion.open(name, on, sink)
        except SwitchboardError:
            sink.close()
            raise
        return _Publishing(sink, on.topic, name)

    def _unadvertise(self, message: link.Unadvertise) -> None:
        self._unpublish(message.number)

    def _unpublish(self, number: int) -> None:
        publishing = self._publishing.pop(number, None)
        if publishing is None:
            return
        if publishing.motion is not None:
            self._motion.close(publishing.motion)
        else:
            publishing.sink.close()

    def _call(self, message: link.CallService) -> None:
        id = message.id
        if id in self._calls:
            raise _Again(f"a call with the id '{id}' is under way")
        _check_room(self._calls, "calls")
        if message.cdr is None:
            raise _Again(f"the arguments of {message.service} must come as CDR")
        request = link.from_base64(message.cdr, "cdr")
        timeout = message.timeout if 0 < message.timeout < math.inf else CALL_SECONDS
        answer = self._platform.call(message.service, message.type, request, timeout)
        done = answer.addCallbacks(
            lambda body: self._wire.say(link.ServiceResponse(id=id, result=True, cdr=link.to_base64(body))),
            lambda failure: self._call_failed(message, failure),
        )
        self._calls[id] = done
        done.addBoth(lambda _: self._calls.pop(id, None) and None)

    def _call_failed(self, message: link.CallService, failure: Failure) -> None:
        if isinstance(failure.value, CancelledError):
            return
        if isinstance(failure.value, SwitchboardError):
            self._fail(message, failure.getErrorMessage())
            return
        self._log.failure("a call of {service} failed", failure, service=message.service)
        self._fail(message, "the robot could not make this call; its log says why")

    def _get_type(self, message: link.GetType) -> None:
        self._wire.say(self._platform.definition(message.type))

    def _fail(self, message: link.Message, reason: str) -> None:
        if isinstance(message, link.CallService):
            self._wire.say(link.ServiceResponse(id=message.id, result=False, reason=reason))
            return
        ref = getattr(message, "type" if isinstance(message, link.GetType) else "number", "")
        what = link.lower_tag(type(message).__name__)
        self._wire.say(link.Failed(what=what, ref=str(ref), reason=reason))

    # --- samples -------------------------------------------------------------------------------------------

    def _sampled(self, number: int, body: bytes) -> None:
        self.uplink.offer(number, self._wall(), body)
        if self._flush is None and self.uplink.waiting:
            # Zero seconds: after all samples of this turn of the reactor, so they share a write.
            self._flush = self._clock.callLater(0, self.flush)
        self._arm_release()

    def flush(self) -> None:
        """Write what waits, as far as the transport takes it."""
        if self._flush is not None and self._flush.active():
            self._flush.cancel()
        self._flush = None
        while chunk := self.uplink.take(CHUNK):
            self._wire.write(chunk)
        if self.uplink.paused:
            self.uplink.trim()

    def pause(self) -> None:
        """The transport is full."""
        self.uplink.paused = True

    def resume(self) -> None:
        """The transport has room again."""
        self.uplink.paused = False
        self.flush()

    def _arm_release(self) -> None:
        due = self.uplink.next_due()
        if self._release is not None and self._release.active():
            if due is not None and self._release.getTime() <= due:
                return
            self._release.cancel()
        self._release = None
        if due is not None:
            self._release = self._clock.callLater(max(0.0, due - self._clock.seconds()), self._let_go)

    def _let_go(self) -> None:
        self._release = None
        self.uplink.release()
        self.flush()
        self._arm_release()


class _Again(SwitchboardError):
    """A request of the right form that this channel can't take."""


def _check_room(table: Sized, what: str) -> None:
    if len(table) >= MAX_OPEN:
        raise _Again(f"this channel has {MAX_OPEN} {what} open; end some first")


_HANDLERS: dict[type, Callable[[Channel, Any], None]] = {
    link.Subscribe: Channel._subscribe,
    link.Unsubscribe: Channel._unsubscribe,
    link.Advertise: Channel._advertise,
    link.Unadvertise: Channel._unadvertise,
    link.CallService: Channel._call,
    link.GetType: Channel._get_type,
}
