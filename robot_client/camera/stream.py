"""One stream: the newest picture of a camera, made when the uplink bears it, sent over a link of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from msgspec.structs import replace
from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import limits, link
from relay_protocol.errors import SwitchboardError, Unavailable
from robot_client.camera.frame import Encoded, EncodeRequest, Frame
from robot_client.camera.ipc import OpenStream
from robot_client.camera.messages import Damaged
from robot_client.camera.packetizer import Packetizer
from robot_client.camera.rate_control import TARGET, RateControl
from robot_client.camera.rtt_probe import RttProbe
from robot_client.link.protocol import Event, JoinedChannel, LinkEnded, MessageReceived
from robot_client.link.transport import LinkLost, LinkProtocol
from robot_client.twisted_types import DelayedCall, ReactorClock

FAULTS = 10
"""Pictures in a row that may be damaged before a stream is given up that has shown none. One that has shown some
outlives any number of pictures that can't be shown; only an encoder of H.264 that fails so often is given up, since
another codec may do."""

BEARS = 5.0
"""Seconds after a damaged picture in which the first good one must come: viewers who wait are told what is wrong before
the relay tells them that nothing came."""

TELL_EVERY = 1.0
"""Seconds between two words of ``playing`` that differ in nothing but what is measured."""


class Busy(Unavailable):
    """As many streams are made as this robot can."""


class CameraViewPort(Protocol):
    """A camera as one stream has it."""

    @property
    def fps(self) -> float:
        """Pictures per second, as they came of late."""

    @property
    def latched(self) -> bool:
        """Whether its publisher keeps the latest picture for those who come later."""

    def make(self, shot: Frame, wish: EncodeRequest) -> Deferred[Encoded]:
        """Make a picture to be sent, in a thread; one at a time."""

    def latest(self) -> Frame | None:
        """The newest picture there was before, if it is still what the camera shows."""

    def close(self) -> None:
        """Want it no more."""


Watch = Callable[[OpenStream, Callable[[Frame], None]], CameraViewPort]
"""Gives a camera to a stream; raises a :class:`SwitchboardError` when it can't be had."""


class EncodedStream:
    """Shows one camera on one link.

    :param line: what was asked for
    :param protocol: the connection
    :param watch: gives the camera
    :param on_gone: called once when the link is gone, with the reason
    :param way: what is known of the way to this relay
    :param target: delay to stay under, seconds
    """

    def __init__(
        self,
        line: OpenStream,
        protocol: LinkProtocol,
        watch: Watch,
        clock: ReactorClock,
        on_gone: Callable[[EncodedStream, str], None],
        way: RttProbe,
        target: float = TARGET,
    ) -> None:
        self.line = line
        self.pace = RateControl(line.settings, way, target)
        self._protocol = protocol
        self._leaving = Packetizer(self.pace, protocol.write)
        self._watch = watch
        self._clock = clock
        self._on_gone = on_gone
        self._view: CameraViewPort | None = None
        self._newest: Frame | None = None
        self._working = False
        self._key = True
        self._broken = False
        """Whether the relay lacks a picture that those made of H.264 need, up to one that stands alone."""
        self._number = 0
        self._faults = 0
        self._fault: tuple[float, str] | None = None
        """Since when pictures can't be shown, once some were, and why not."""
        self._damaged: tuple[float, str] | None = None
        """When the first picture came that was damaged, while none was shown, and in what way."""
        self._told: link.Playing | None = None
        self._told_at = 0.0
        self._timer: DelayedCall | None = None
        self._looking: DelayedCall | None = None
        self._log = Logger("camera")

    # --- the link ------------------------------------------------------------------------------------------

    def on_event(self, event: Event) -> None:
        """The relay said something."""
        if isinstance(event, JoinedChannel):
            self._joined(event.channel)
        elif isinstance(event, MessageReceived) and isinstance(event.message, link.Took):
            self._took(event.message)
        elif isinstance(event, MessageReceived):
            self._key = True
            self._repeat()
            self._next()
        elif isinstance(event, LinkEnded):
            self._protocol.end(LinkLost(f"the relay closed the stream: {event.reason}"), gently=True)

    def on_lost(self, reason: SwitchboardError) -> None:
        """The connection is gone."""
        self._stop()
        self._on_gone(self, str(reason))

    def on_pause(self) -> None:
        """What is not taken yet holds up the next picture; the transport's own limit adds nothing."""

    def on_resume(self) -> None:
        """See :meth:`on_pause`."""

    def close(self, why: str) -> None:
        """Show no more."""
        self._stop()
        self._say(link.Bye(reason=why))
        self._protocol.end(LinkLost(why), gently=True)

    def refuse(self, reason: str, busy: bool = False) -> None:
        """Tell that it can't be shown."""
        self._stop()
        self._say(link.NotPlaying(reason=reason, busy=busy))
        self._protocol.end(LinkLost(reason), gently=True)

    def _joined(self, name: str) -> None:
        if name != self.line.stream:
            self._protocol.end(LinkLost(f"the relay joined us to '{name}' instead of '{self.line.stream}'"))
            return
        try:
            self._view = self._watch(self.line, self._on_shot)
        except SwitchboardError as error:
            self.refuse(str(error), busy=isinstance(error, Busy))
            return
        self._looking = self._clock.callLater(TELL_EVERY, self._look)
        before = self._view.latest()
        if before is not None:
            self._on_shot(before.again(self._clock.seconds()))

    def _repeat(self) -> None:
        """Have a picture that its publisher keeps made once more: no other one may follow."""
        kept = self._view.latest() if self._view is not None and self._view.latched else None
        if kept is not None and self._newest is None:
            self._newest = kept.again(self._clock.seconds())

    def _say(self, message: link.Message) -> None:
        self._protocol.link.say(message)
        self._protocol.flush()

    def _stop(self) -> None:
        view, self._view = self._view, None
        if view is not None:
            view.close()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._looking is not None:
            self._looking.cancel()
            self._looking = None
        self._newest = None
        self.pace.close(self._clock.seconds())

    # --- pictures ------------------------------------------------------------------------------------------

    def _on_shot(self, shot: Frame) -> None:
        self._newest = shot
        self._next()

    def _next(self) -> None:
        """Make the newest picture, if one made now would be there in time."""
        if self._newest is None or self._working or self._view is None:
            return
        now = self._clock.seconds()
        if not self.pace.may_send(now):
            wait = self.pace.wait(now)
            if wait > 0 and self._timer is None:
                self._timer = self._clock.callLater(wait, self._waited)
            return
        shot, self._newest = self._newest, None
        pace = self.pace
        wish = EncodeRequest(
            pace.quality, pace.scale, pace.reduced > 0, self._key, pace.fps or self._view.fps
        )
        self._working, self._key = True, False
        self._view.make(shot, wish).addCallbacks(
            self._made, self._not_made, callbackArgs=(shot, wish), errbackArgs=(wish,)
        ).addErrback(self._failed)

    def _waited(self) -> None:
        self._timer = None
        self._next()

    def _made(self, made: Encoded, shot: Frame, wish: EncodeRequest) -> None:
        self._working = False
        if self._view is None:
            return
        self._faults = 0
        self._fault = None
        alone = wish.key or self.line.settings.codec != "h264"
        if self._broken and not alone:
            self._newest = self._newest or shot
            self._next()
            return
        self._broken = False
        self._damaged = None
        self._number += 1
        self._tell(made, wish, self._view)
        self._leaving.put(self._number, shot, made.body, self._clock.seconds(), alone)
        self._next()

    def _not_made(self, failure: Failure, wish: EncodeRequest) -> None:
        self._working = False
        if self._view is None:
            return
        failure.trap(SwitchboardError)
        self._key = self._key or wish.key
        self._faults += 1
        reason = failure.getErrorMessage()
        # Cameras often begin with a damaged picture or two, but another encoding or size will not come by itself.
        if self._number:
            no_encoder = self.line.settings.codec == "h264" and failure.check(Unavailable) is not None
            hopeless = no_encoder and self._faults >= FAULTS
        else:
            hopeless = failure.check(Damaged) is None or self._faults >= FAULTS
        if hopeless:
            self.refuse(reason)
            return
        if not self._number and self._damaged is None:
            self._damaged = self._clock.seconds(), reason
        self._bear(reason)

    def _failed(self, failure: Failure) -> None:
        if self._fault is None:
            self._log.failure("a picture could not be made", failure=failure)
        reason = "a picture could not be made; the robot's log says why"
        if self._number and self._view is not None:
            self._bear(reason)
        elif self._view is not None:
            self.refuse(reason)

    def _bear(self, reason: str) -> None:
        """Go on with the next picture; :meth:`_look` tells why none comes, if that lasts."""
        if self._number:
            since = self._clock.seconds() if self._fault is None else self._fault[0]
            self._fault = since, reason
        self._next()

    def _took(self, took: link.Took) -> None:
        measured = self._protocol.link.offset.round_trip
        round_trip = measured / 1e9 if measured is not None else None
        if self._leaving.answered(took, self._clock.seconds(), round_trip):
            self._key = self._broken = True  # what follows in H.264 must not need what was given up
            if not self._working:
                self._repeat()
        self._next()

    def _look(self) -> None:
        """Who publishes the pictures may be known, or be another one, only after the picture that is shown; and where a
        picture was damaged, no other one may come.
        """
        if self._damaged is not None and self._clock.seconds() - self._damaged[0] >= BEARS:
            self._looking = None
            self.refuse(self._damaged[1])
            return
        self._looking = self._clock.callLater(TELL_EVERY, self._look)
        if self._told is None or self._view is None:
            return
        trouble = ""
        if self._fault is not None and self._clock.seconds() - self._fault[0] >= TELL_EVERY:
            trouble = self._fault[1]
        now = replace(self._told, latched=self._view.latched, trouble=trouble)
        if now != self._told:
            self._told = now
            self._say(now)

    def _tell(self, made: Encoded, wish: EncodeRequest, view: CameraViewPort) -> None:
        """Say how this picture and those that follow are, if the relay does not know."""
        delay = self.pace.delay
        playing = link.Playing(
            width=made.width,
            height=made.height,
            quality=wish.quality,
            fps=self.pace.fps,
            reduced=round(self.pace.reduced, 3),
            delay_ms=None if delay is None else round(delay * 1000, 1),
            encoding=made.encoding[: limits.LABEL],
            source_fps=view.fps,
            latched=view.latched,
        )
        now = self._clock.seconds()
        if self._told is not None:
            same = playing == replace(self._told, delay_ms=playing.delay_ms, source_fps=playing.source_fps)
            if playing == self._told or (same and now - self._told_at < TELL_EVERY):
                return
        self._told, self._told_at = playing, now
        self._protocol.link.say(playing)
