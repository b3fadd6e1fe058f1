"""A running recording: a subscriber of the robot's channel, and a viewer of its cameras, that writes what it
gets."""

from __future__ import annotations

import enum
import struct
from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol import link, rosbridge
from relay_protocol.errors import Invalid, SwitchboardError
from relay_protocol.limits import MIB
from relay_server.access import Permit, Principal, is_image_topic
from relay_server.channels.channel import Channel
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.samples import Converter, Sample
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.recordings.clock_jumps import ClockJumps
from relay_server.recordings.library import RecordingEntry, RecordingState, why_denied
from relay_server.recordings.mcap_file import McapChannel
from relay_server.recordings.writer import RecordedMessage, RecordingWriter, WriteOutcome
from relay_server.video.frames import VideoFrameInfo
from relay_server.video.stream import CameraStream, differing
from relay_server.video.streams import CameraStreams

TYPE = "sensor_msgs/msg/CompressedImage"

_RULE = "=" * 80

TEXT = f"""\
std_msgs/Header header
string format
uint8[] data
{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

_HEAD = b"\x00\x01\x00\x00"
_SUFFIX = "/compressed"


def topic_of(camera: str) -> str:
    """The topic of a camera's images, named as by image_transport."""
    return camera if camera.endswith(_SUFFIX) else camera + _SUFFIX


def message(frame: bytes, stamp: int, codec: str) -> bytes:
    """An image as a CompressedImage message in CDR.

    :param frame: the bytes of an image file
    :param stamp: when it was taken, nanoseconds since 1970
    :param codec: ``jpeg`` or ``png``
    """
    out = bytearray(_HEAD)
    out += struct.pack("<iI", *divmod(stamp, 10**9))
    # The frame_id is not known: images come without the message they were in.
    for text in ("", codec):
        body = text.encode() + b"\x00"
        out += struct.pack("<I", len(body)) + body
        # Four-byte numbers are aligned to four bytes, counted from behind the encapsulation header of four
        # bytes.
        out += bytes(-len(out) % 4)
    return bytes(out + struct.pack("<I", len(frame)) + frame)


RETRY_SECONDS = 5.0
"""A camera that is not shown any more is requested again after this time; so is saving."""

HELD = 100
HELD_BYTES = 8 * MIB
"""Most bytes of samples that wait until it is saved that their topics carry images, or until a simulated
clock is known. Further ones are dropped and counted."""

PROBLEMS = 20
"""Most problems stored with a recording."""

NAMED = 10
"""Most topics that the problem of missing ones names."""

STAMPS_END = 2**31 * 10**9
"""The first nanosecond that ``builtin_interfaces/Time`` cannot represent, in January 2038."""

AS_IT_IS = link.VideoSettings()
"""How cameras are recorded."""


class RecordingEvent(enum.Enum):
    """Events of a recording."""

    ENOUGH = "enough"
    WRITTEN = "written"
    BROKEN = "broken"


NEXT: dict[tuple[RecordingState, RecordingEvent], RecordingState] = {
    (RecordingState.RECORDING, RecordingEvent.ENOUGH): RecordingState.FINISHING,
    (RecordingState.RECORDING, RecordingEvent.WRITTEN): RecordingState.COMPLETE,
    (RecordingState.RECORDING, RecordingEvent.BROKEN): RecordingState.INCOMPLETE,
    (RecordingState.FINISHING, RecordingEvent.WRITTEN): RecordingState.COMPLETE,
    (RecordingState.FINISHING, RecordingEvent.BROKEN): RecordingState.INCOMPLETE,
}
"""Events that are not listed for a state change nothing."""


class Recorder:
    """Records topics and cameras of one robot.

    :param permit: of the user; the recording ends with it
    :param make_writer: makes the writer of the file from a function to be called at its end
    :param wall: Unix time in seconds
    :param changed: saves the description, and returns whether that worked; called when topics are found to
        carry images, so that the rights on the file are known even after a crash
    :param ended: called once, when the file is finished or given up
    """

    log = Logger()
    plain_instead = 0
    queued_bytes = 0

    def __init__(
        self,
        clock: Clock,
        entry: RecordingEntry,
        permit: Permit,
        channel: Channel,
        videos: CameraStreams,
        make_writer: Callable[[Callable[[WriteOutcome], None]], RecordingWriter],
        *,
        wall: Callable[[], float],
        changed: Callable[[RecordingEntry], Deferred[bool]],
        ended: Callable[[Recorder], None],
    ) -> None:
        self._clock = clock
        self.entry = entry
        self.permit = permit
        self._channel = channel
        self._videos = videos
        self._writer = make_writer(self._written)
        self._wall = wall
        self._changed = changed
        self._ended = ended
        self._timer: Timer | None = None
        self._save_timer: Timer | None = None
        self._saving = False
        self._unsaved: set[str] = set()
        """Topics with images that are not saved as such."""
        self._held: list[tuple[str, Sample, int]] = []
        """Samples that wait, with the arguments of :meth:`keep`."""
        self._timeless = False
        """Whether samples wait for the time of a simulation."""
        self._tracks: dict[str, tuple[Converter, McapChannel]] = {}
        self._eyes = [CameraTap(clock, self, camera) for camera in entry.cameras]
        self._lost = 0
        self._unsubscribed: set[str] = set()
        """Topics that the robot does not have yet."""
        self._missing = dict.fromkeys(entry.topics)
        """Topics that the robot has not had so far, in their order."""
        self._missing_problem = ""
        self._jumps = ClockJumps(clock)

    @property
    def principal(self) -> Principal:
        return self.permit.principal

    @property
    def user(self) -> int:
        """The user's number."""
        return self.principal.user_id

    # --- life ---------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin recording.

        :raises SwitchboardError: something cannot be recorded; then nothing has begun
        """
        self._channel.attach(self)
        self._find_image_topics()
        try:
            for topic in self.entry.topics:
                self._subscribe(topic)
            for tap in self._eyes:
                tap.open()
        except SwitchboardError:
            self._release()
            raise
        self.permit.on_change = self._check_rights
        self.permit.on_revoke = lambda error: self.stop(str(error))
        self._channel.robot_clock.on_jump.append(self._time_jumped)
        self._timer = self._clock.callLater(self.entry.seconds, self.stop, "its time is over")
        self._writer.start()
        self.recheck_rights()

    def _subscribe(self, topic: str) -> None:
        """Subscribe to a topic, or note that it is to be done when the robot has it.

        :raises SwitchboardError: it can't be recorded
        """
        listener = TopicTap(self._clock, self, topic)
        listener.add(rosbridge.Subscribe(topic=topic))
        try:
            self._channel.subscriptions.add(self, listener, "", None)
        except Invalid:
            if topic in self._channel.robot.graph.topics:
                raise
            self._unsubscribed.add(topic)
        else:
            self._unsubscribed.discard(topic)

    def _subscribe_to_new(self) -> None:
        """Subscribe to topics that the robot has now, and say which it still has not."""
        there = self._channel.robot.graph.topics
        for topic in sorted(self._unsubscribed & there.keys()):
            try:
                self._subscribe(topic)
            except SwitchboardError as error:
                self.notify("error", f"{topic}: {error}")
        if self._channel.link_state.link is not None:
            self._note_missing("do not exist yet, and are recorded when they come")

    def _note_missing(self, words: str) -> None:
        active = (topic for topic, _ in self._channel.subscriptions.active())
        for topic in (*self._channel.robot.graph.topics, *active):
            self._missing.pop(topic, None)
        names = list(self._missing)
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        text = f"these topics {words}: {', '.join(names[:NAMED])}{more}" if names else ""
        if text != self._missing_problem:
            problems = self.entry.problems
            if self._missing_problem in problems:
                problems.remove(self._missing_problem)
            self._missing_problem = text
            if text:
                self.notify("warning", text)

    def stop(self, reason: str) -> None:
        """Finish the file with the samples so far."""
        if self.entry.state is RecordingState.RECORDING:
            self._note_missing("did not exist while it was recorded")
        if self._handle(RecordingEvent.ENOUGH, reason):
            self._release()
            self._writer.finish()

    def count(self) -> None:
        """Update the entry's numbers."""
        writer = self._writer
        self.entry.bytes, self.entry.messages = writer.bytes, writer.messages
        self.entry.drops = self._lost + writer.broken

    def _handle(self, event: RecordingEvent, reason: str) -> bool:
        following = NEXT.get((self.entry.state, event))
        if following is None:
            return False
        self.entry.state = following
        self.entry.reason = self.entry.reason or reason
        return True

    def _written(self, outcome: WriteOutcome) -> None:
        """The writer has ended, by order or by itself."""
        if self._handle(
            RecordingEvent.WRITTEN if outcome.finished else RecordingEvent.BROKEN, outcome.reason
        ):
            self._release()
            self.count()
            self.entry.ended = self._wall()
            self._ended(self)

    def _release(self) -> None:
        cancel(self._timer)
        cancel(self._save_timer)
        if self._time_jumped in self._channel.robot_clock.on_jump:
            self._channel.robot_clock.on_jump.remove(self._time_jumped)
        self._lost += len(self._held)
        self._held.clear()
        for tap in self._eyes:
            tap.close()
        self._channel.detach(self)

    def recheck_rights(self) -> None:
        """A topic may carry images that did not before, or have come."""
        self._find_image_topics()
        self._check_rights()
        if self.entry.state is RecordingState.RECORDING:
            self._subscribe_to_new()
        self._save_topics()

    def _find_image_topics(self) -> None:
        entry, robot = self.entry, self._channel.robot
        # A topic that the robot does not have now keeps its kind.
        there = [topic for topic in entry.topics if topic in robot.graph.topics]
        more = {topic for topic in there if is_image_topic(robot, topic)}.difference(entry.pictures)
        entry.pictures = tuple(sorted({*entry.pictures, *more}))
        self._unsaved |= more

    def _save_topics(self) -> None:
        """Save which topics carry images, so that it is known even after a crash."""
        if self._unsaved and not self._saving and self.entry.state is RecordingState.RECORDING:
            self._saving = True
            self._changed(self.entry).addCallback(self._topics_saved, frozenset(self._unsaved))

    def _topics_saved(self, saved: bool, topics: frozenset[str]) -> None:
        self._saving = False
        if self.entry.state is not RecordingState.RECORDING:
            return
        if not saved:
            self.notify("error", "a topic was found to carry images, and that could not be saved")
            cancel(self._save_timer)
            self._save_timer = self._clock.callLater(RETRY_SECONDS, self._save_topics)
            return
        self._unsaved -= topics
        self._write_held()
        self._save_topics()

    def _write_held(self) -> None:
        self._timeless = False
        held, self._held = self._held, []
        for each in held:
            self.keep(*each)

    def _check_rights(self) -> None:
        reason = why_denied(self.permit, self.entry)
        if reason:
            self.stop(reason)

    # --- samples and frames -------------------------------------------------------------------------------

    @property
    def now_ns(self) -> int:
        """The robot's time, nanoseconds."""
        return self._channel.now_ns()

    def not_before(self, ros_time_ns: int) -> int:
        """The robot's time now. A wall clock may be ahead of ours; a simulation's time is taken as it is.

        :param ros_time_ns: nanoseconds
        """
        return self.now_ns if self._simulated else max(ros_time_ns, self.now_ns)

    def notify(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Notices for a client are stored with the recording."""
        problems = self.entry.problems
        if text not in problems and len(problems) < PROBLEMS:
            problems.append(text)

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Nothing: all drops are counted and stored with the recording, by :meth:`samples_dropped`."""

    def dropped(self, subscription: ClientSubscription) -> None:
        """A sample was dropped before it came here."""
        self._lost += 1
        self.notify(
            "warning",
            f"messages of {subscription.topic} were lost because they came faster than they were taken",
        )

    def samples_dropped(self, topic: str, count: int) -> None:
        """The robot did not send samples of a topic."""
        self._lost += count
        self.notify("warning", f"messages of {topic} were lost because the robot did not send them")

    def frames_damaged(self, camera: str, count: int) -> None:
        """Frames of a camera could not be shown."""
        self._lost += count
        self.notify("warning", f"{camera}: frames were left out because they are damaged")

    def deliver(self, subscription: ClientSubscription, sample: Sample) -> None:
        """A sample of a topic, as it comes."""
        topic, stamp = subscription.topic, sample.ros_time_ns
        # Samples of several publishers that latch may come in any order.
        if not self._channel.subscriptions.latched(topic):
            self._check_clock(topic, stamp)
        self.keep(topic, sample, stamp)

    def _check_clock(self, name: str, stamp: int) -> None:
        """Note a jump of the robot's clock; those of a simulation are known.

        :param name: of a topic or a camera, whose stamps grow
        :param stamp: nanoseconds
        """
        if self._simulated or not 0 < stamp < STAMPS_END:
            return
        jump = self._jumps.seconds(name, stamp)
        if jump:
            self._note_jump("the robot's clock", jump)

    def _time_jumped(self, seconds: float) -> None:
        self._note_jump("the robot's simulated time", seconds)

    def _note_jump(self, clock: str, seconds: float) -> None:
        direction = "back" if seconds < 0 else "forward"
        by = f" by {abs(seconds):.0f} s" if abs(seconds) >= 1.0 else ""
        self.notify("warning", f"{clock} jumped {direction}{by}; times before and after it do not compare")

    def keep(self, topic: str, sample: Sample, log_time: int) -> None:
        """Write a sample.

        :param log_time: nanoseconds; 0 until a simulation's time is known
        """
        if not self._clock_known():
            self._timeless = True
            self._hold(topic, sample, log_time)
            return
        if self._timeless:
            self._write_held()
        if topic in self._unsaved:
            self._hold(topic, sample, log_time)
            return
        converter = sample.converter
        found = self._tracks.get(topic)
        if found is None or found[0] is not converter:
            found = self._tracks[topic] = (converter, self._channel_of(topic, converter))
        make = None if converter.cdr else _reencode(converter)
        logged, published = self._valid_stamp(topic, log_time), self._valid_stamp(topic, sample.ros_time_ns)
        self._put(RecordedMessage(found[1], logged, published, sample.body, make))

    def _hold(self, topic: str, sample: Sample, log_time: int) -> None:
        size = sum(len(each.body) for _, each, _ in self._held) + len(sample.body)
        if not self._held or (len(self._held) < HELD and size <= HELD_BYTES):
            self._held.append((topic, sample, log_time))
        else:
            self._lost += 1
            self.notify(
                "warning",
                "messages were lost while the recording waited for the robot's time or the database",
            )

    def _channel_of(self, topic: str, converter: Converter) -> McapChannel:
        if not converter.cdr:
            return McapChannel(topic, converter.type, "json")
        latched = self._channel.subscriptions.latched(topic)
        return McapChannel(topic, converter.type, "cdr", converter.types.full_text(converter.type), latched)

    def write_frame(self, camera: str, frame: VideoFrameInfo) -> None:
        """Write a frame of a camera."""
        if not self._clock_known():
            self._lost += 1
            return
        self._check_clock(camera, round(frame.stamp * 1e9))
        # A robot with simulated time has no other time for its frames either.
        stamp = self.now_ns if self._simulated else self._valid_stamp(camera, round(frame.stamp * 1e9))

        def make(body: bytes) -> bytes:
            return message(body, stamp, frame.codec)

        track = McapChannel(topic_of(camera), TYPE, "cdr", TEXT)
        self._put(RecordedMessage(track, stamp, stamp, frame.body, make))

    @property
    def _simulated(self) -> bool:
        return self._channel.robot.description.sim_time

    def _clock_known(self) -> bool:
        """Whether the recording's clock is known. Wall clock stamps must not be mixed with simulated ones."""
        known = not self._simulated or self.now_ns > 0
        if not known:
            self.notify(
                "warning",
                "the robot's time is simulated, and its /clock is silent; samples wait for it",
            )
        return known

    def _valid_stamp(self, name: str, stamp: int) -> int:
        """A robot's stamp, or the time now if no ROS message could carry it: its clock is wrong, or it lies.

        :param stamp: nanoseconds
        """
        if stamp == 0 and self._simulated:
            # It came before the simulation's time was known.
            return self.now_ns
        if 0 <= stamp < STAMPS_END:
            return stamp
        self.notify(
            "error",
            f"{name}: the robot's stamps are beyond what ROS can represent; the relay's time is used instead",
        )
        return self.now_ns

    def _put(self, message: RecordedMessage) -> None:
        if not self._writer.put(message):
            self._lost += 1
            self.notify("warning", "messages were lost because they came faster than the disk takes them")

    def watch(self, camera: str, tap: CameraTap) -> CameraStream:
        """Watch a camera; see :meth:`CameraStreams.watch`."""
        return self._videos.watch(self._channel.robot, camera, AS_IT_IS, tap, first=True)


class TopicTap(ClientSubscription):
    """Accepts every sample of a topic at once."""

    def __init__(self, clock: Clock, recorder: Recorder, topic: str) -> None:
        super().__init__(clock, recorder, topic)
        self._recorder = recorder

    def samples_dropped(self, loss: link.SamplesDropped) -> None:
        self._recorder.samples_dropped(self.topic, loss.count)

    def replay(self, sample: Sample) -> None:
        """An old latched sample: the recording must not seem to have begun then."""
        self._recorder.keep(self.topic, sample, self._recorder.not_before(sample.ros_time_ns))


class CameraTap:
    """Watches one camera while the recording runs, and again after the camera was not available."""

    def __init__(self, clock: Clock, recorder: Recorder, camera: str) -> None:
        self._clock = clock
        self._recorder = recorder
        self._camera = camera
        self._stream: CameraStream | None = None
        self._timer: Timer | None = None
        self._damaged = 0
        """``damaged`` of the latest status."""

    @property
    def user(self) -> int:
        """The user's number."""
        return self._recorder.user

    def open(self) -> None:
        """Start watching.

        :raises Unavailable: there are too many viewers
        """
        self.moved(self._recorder.watch(self._camera, self))

    def close(self) -> None:
        cancel(self._timer)
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.detach(self)

    def frame_received(self, frame: VideoFrameInfo) -> None:
        """Every frame is recorded."""
        self._recorder.write_frame(self._camera, frame)

    def status_changed(self, playing: link.StreamStatus) -> None:
        """Note when frames are smaller or rarer than requested, which the frames themselves do not show."""
        if playing.reduced > 0:
            self._recorder.notify(
                "warning",
                f"{self._camera}: the robot's uplink is slow; for a while its frames are smaller, coarser or fewer",
            )

        if playing.problem:
            self._recorder.notify(
                "warning", f"{self._camera}: no frame could be shown for a while: {playing.problem}"
            )
        before, self._damaged = self._damaged, playing.damaged
        # A lower count is that of another link.
        damaged = playing.damaged - before if playing.damaged >= before else playing.damaged
        if damaged:
            self._recorder.frames_damaged(self._camera, damaged)

    def moved(self, stream: CameraStream) -> None:
        """At the robot's limit the stream of other viewers is recorded, and noted as a problem."""
        self._stream = stream
        self._damaged = 0 if stream.status is None else stream.status.damaged
        other = differing(AS_IT_IS, stream.settings)
        if other:
            words = ", ".join(f"{name} {value}" for name, value in other.items())
            self._recorder.notify(
                "warning",
                f"{self._camera}: the robot is at its limit; for a while frames are recorded as other viewers "
                f"requested them: {words}",
            )

    def ended(self, error: SwitchboardError) -> None:
        """The camera is not available now."""
        self._stream = None
        self._recorder.notify("error", f"{self._camera}: {error}")
        self._timer = self._clock.callLater(RETRY_SECONDS, self._retry)

    def _retry(self) -> None:
        try:
            self.open()
        except SwitchboardError as error:
            self.ended(error)


def _reencode(converter: Converter) -> Callable[[bytes], bytes]:
    """Encodes a robot's own JSON again, so that the file contains well-formed JSON whatever came in."""
    return lambda body: converter.convert("json", body)
