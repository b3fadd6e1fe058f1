"""One recording while it runs: a member of the robot's channel and a viewer of its cameras that writes what comes."""

from __future__ import annotations

import enum
import struct
from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol import link, rosbridge
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import MIB
from relay_server.access import Permit, Principal, is_image_topic
from relay_server.channels.channel import Channel
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.samples import Converter, Sample
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.cpu_quota import UserQuotas
from relay_server.recordings.library import RecordingEntry, RecordingState
from relay_server.recordings.mcap_file import McapChannel
from relay_server.recordings.rights import why_denied
from relay_server.recordings.writer import RecordedMessage, RecordingWriter, WriteOutcome
from relay_server.video.frames import VideoFrameInfo
from relay_server.video.ports import differing
from relay_server.video.stream import CameraStream
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
    """The topic of a camera's pictures; image_transport's name for them."""
    return camera if camera.endswith(_SUFFIX) else camera + _SUFFIX


def message(picture: bytes, stamp: int, codec: str) -> bytes:
    """A picture as a message in CDR.

    :param picture: the bytes of a file
    :param stamp: when it was taken, nanoseconds since 1970
    :param codec: ``jpeg`` or ``png``
    """
    out = bytearray(_HEAD)
    out += struct.pack("<iI", *divmod(stamp, 10**9))
    # The frame is not known here: pictures come without the message they were in.
    for text in ("", codec):
        body = text.encode() + b"\x00"
        out += struct.pack("<I", len(body)) + body
        # Four-byte numbers begin at multiples of four, counted from behind the head, which has four bytes too.
        out += bytes(-len(out) % 4)
    return bytes(out + struct.pack("<I", len(picture)) + picture)


AGAIN_SECONDS = 5.0
"""A camera that is not shown any more is asked for anew after so long; what can't be put on record is tried again."""

HELD = 100
HELD_BYTES = 8 * MIB
"""Most samples that wait: until it is on record that their topics carry pictures, or until a simulated clock tells the
time. What comes beyond is dropped, and counted."""

PROBLEMS = 20
"""Most that is kept of what was not as it should be."""

STAMPS_END = 2**31 * 10**9
"""The first nanosecond that ``builtin_interfaces/Time`` can't hold, in January 2038."""

AS_IT_IS = link.VideoSettings()
"""How cameras are recorded."""

_NOBODY = -1


class RecordingEvent(enum.Enum):
    """What happens to a recording."""

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
"""An event that is not listed for a state changes nothing."""


class Recorder:
    """See the module's text.

    :param permit: of who records; the recording ends with it
    :param make_writer: makes the writer of the file, given what to call at its end
    :param wall: Unix time in seconds
    :param changed: puts on the disk what the recording is, and tells whether that was done; called when topics are
        found to carry pictures: who may have the file must be known also after a crash
    :param ended: called once, when the file is whole or has been given up
    """

    log = Logger()
    plain_instead = 0
    queued_bytes = 0
    allowance = UserQuotas(lambda: 0.0, lambda: 0.0).of(_NOBODY)
    """Nothing is taken from it: samples are written as the robot sends them."""

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
        """Topics of pictures that are not on record as such."""
        self._held: list[tuple[str, Sample, int]] = []
        """Samples that wait, as :meth:`keep` takes them."""
        self._timeless = False
        """Whether samples wait for the time of a simulation."""
        self._tracks: dict[str, tuple[Converter, McapChannel]] = {}
        self._eyes = [CameraTap(clock, self, camera) for camera in entry.cameras]
        self._lost = 0

    @property
    def principal(self) -> Principal:
        """Who records."""
        return self.permit.principal

    @property
    def user(self) -> int:
        """Whose it is."""
        return self.principal.user_id

    # --- life ---------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin.

        :raises SwitchboardError: something can't be recorded; then nothing has begun
        """
        self._channel.attach(self)
        self._look_for_pictures()
        try:
            for topic in self.entry.topics:
                listener = TopicTap(self._clock, self, topic)
                listener.add(rosbridge.Subscribe(topic=topic))
                self._channel.subscriptions.add(self, listener, "", None)
            for eye in self._eyes:
                eye.open()
        except SwitchboardError:
            self._let_go()
            raise
        self.permit.on_change = self._judge
        self.permit.on_revoke = lambda error: self.stop(str(error))
        self._timer = self._clock.callLater(self.entry.seconds, self.stop, "it has taken its time")
        self._writer.start()
        self.judge_again()

    def stop(self, reason: str) -> None:
        """It is enough: finish the file. What came so far is in it."""
        if self._happen(RecordingEvent.ENOUGH, reason):
            self._let_go()
            self._writer.finish()

    def count(self) -> None:
        """Bring what the entry says of the file up to date."""
        writer = self._writer
        self.entry.bytes, self.entry.messages = writer.bytes, writer.messages
        self.entry.drops = self._lost + writer.broken

    def _happen(self, event: RecordingEvent, reason: str) -> bool:
        following = NEXT.get((self.entry.state, event))
        if following is None:
            return False
        self.entry.state = following
        self.entry.reason = self.entry.reason or reason
        return True

    def _written(self, outcome: WriteOutcome) -> None:
        """The writer has ended, because it was told to or by itself."""
        if self._happen(
            RecordingEvent.WRITTEN if outcome.finished else RecordingEvent.BROKEN, outcome.reason
        ):
            self._let_go()
            self.count()
            self.entry.ended = self._wall()
            self._ended(self)

    def _let_go(self) -> None:
        cancel(self._timer)
        cancel(self._save_timer)
        self._lost += len(self._held)
        self._held.clear()
        for eye in self._eyes:
            eye.close()
        self._channel.detach(self)

    def judge_again(self) -> None:
        """A topic may carry pictures that did not before."""
        self._look_for_pictures()
        self._judge()
        self._put_on_record()

    def _look_for_pictures(self) -> None:
        entry, robot = self.entry, self._channel.robot
        # One that the robot does not have just now is what it was.
        there = [topic for topic in entry.topics if topic in robot.graph.topics]
        more = {topic for topic in there if is_image_topic(robot, topic)}.difference(entry.pictures)
        entry.pictures = tuple(sorted({*entry.pictures, *more}))
        self._unsaved |= more

    def _put_on_record(self) -> None:
        """See that it is known of all topics of pictures, also after a crash, that they are such."""
        if self._unsaved and not self._saving and self.entry.state is RecordingState.RECORDING:
            self._saving = True
            self._changed(self.entry).addCallback(self._on_record, frozenset(self._unsaved))

    def _on_record(self, saved: bool, topics: frozenset[str]) -> None:
        self._saving = False
        if self.entry.state is not RecordingState.RECORDING:
            return
        if not saved:
            self.tell("error", "a topic was found to carry pictures, and that could not be put on record")
            cancel(self._save_timer)
            self._save_timer = self._clock.callLater(AGAIN_SECONDS, self._put_on_record)
            return
        self._unsaved -= topics
        self._keep_held()
        self._put_on_record()

    def _keep_held(self) -> None:
        self._timeless = False
        held, self._held = self._held, []
        for each in held:
            self.keep(*each)

    def _judge(self) -> None:
        reason = why_denied(self.permit, self.entry)
        if reason:
            self.stop(reason)

    # --- what comes ---------------------------------------------------------------------------------------

    @property
    def now_ns(self) -> int:
        """The robot's time, nanoseconds."""
        return self._channel.now_ns()

    def not_before(self, stamp: int) -> int:
        """The robot's time now; a wall clock may be ahead of ours, a simulation's is ours too.

        :param stamp: nanoseconds
        """
        return self.now_ns if self._simulated else max(stamp, self.now_ns)

    def tell(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """What a client would be told is kept with the recording."""
        problems = self.entry.problems
        if text not in problems and len(problems) < PROBLEMS:
            problems.append(text)

    def dropped(self, listener: ClientSubscription) -> None:
        """A sample gave way before it came here."""
        self._lost += 1
        self.tell(
            "warning", f"messages of {listener.topic} were lost because they came faster than they were taken"
        )

    def missed(self, topic: str, count: int) -> None:
        """Samples of a topic were not sent by the robot."""
        self._lost += count
        self.tell("warning", f"messages of {topic} were lost because the robot did not send them")

    def deliver(self, listener: ClientSubscription, parcel: Sample) -> None:
        """A sample of a topic, as it comes."""
        self.keep(listener.topic, parcel, parcel.stamp)

    def keep(self, topic: str, sample: Sample, log_time: int) -> None:
        """Have a sample written.

        :param log_time: nanoseconds; 0 while a simulation has not told the time
        """
        if not self._knows_time():
            self._timeless = True
            self._hold(topic, sample, log_time)
            return
        if self._timeless:
            self._keep_held()
        if topic in self._unsaved:
            self._hold(topic, sample, log_time)
            return
        converter = sample.converter
        found = self._tracks.get(topic)
        if found is None or found[0] is not converter:
            found = self._tracks[topic] = (converter, self._track(topic, converter))
        make = None if converter.cdr else _anew(converter)
        logged, published = self._lawful(topic, log_time), self._lawful(topic, sample.stamp)
        self._put(RecordedMessage(found[1], logged, published, sample.body, make))

    def _hold(self, topic: str, sample: Sample, log_time: int) -> None:
        size = sum(len(each.body) for _, each, _ in self._held) + len(sample.body)
        if not self._held or (len(self._held) < HELD and size <= HELD_BYTES):
            self._held.append((topic, sample, log_time))
        else:
            self._lost += 1
            self.tell(
                "warning",
                "messages were lost while the recording waited for the robot's time or the database",
            )

    def _track(self, topic: str, converter: Converter) -> McapChannel:
        if not converter.cdr:
            return McapChannel(topic, converter.type, "json")
        latched = self._channel.subscriptions.latched(topic)
        return McapChannel(topic, converter.type, "cdr", converter.types.full_text(converter.type), latched)

    def saw(self, camera: str, picture: VideoFrameInfo) -> None:
        """Have a picture written."""
        if not self._knows_time():
            self._lost += 1
            return
        # A robot whose time is simulated has no other for its pictures either.
        stamp = self.now_ns if self._simulated else self._lawful(camera, round(picture.stamp * 1e9))

        def make(body: bytes) -> bytes:
            return message(body, stamp, picture.codec)

        track = McapChannel(topic_of(camera), TYPE, "cdr", TEXT)
        self._put(RecordedMessage(track, stamp, stamp, picture.body, make))

    @property
    def _simulated(self) -> bool:
        return self._channel.robot.description.sim_time

    def _knows_time(self) -> bool:
        """Whether the recording's clock is known: wall clock stamps must not stand beside simulated ones."""
        known = not self._simulated or self.now_ns > 0
        if not known:
            self.tell(
                "warning",
                "the robot's time is simulated, and its /clock says nothing; what comes meanwhile waits for it",
            )
        return known

    def _lawful(self, name: str, stamp: int) -> int:
        """A robot's stamp, or now where no message of ROS could hold it: its clock is broken, or it lies.

        :param stamp: nanoseconds
        """
        if stamp == 0 and self._simulated:
            # It came before the simulation told the time.
            return self.now_ns
        if 0 <= stamp < STAMPS_END:
            return stamp
        self.tell(
            "error",
            f"{name}: the robot's stamps are beyond what ROS can hold; the relay's time stands for them",
        )
        return self.now_ns

    def _put(self, message: RecordedMessage) -> None:
        if not self._writer.put(message):
            self._lost += 1
            self.tell("warning", "messages were lost because they came faster than the disk takes them")

    def watch(self, camera: str, eye: CameraTap) -> CameraStream:
        """Have a camera shown; see :meth:`CameraStreams.watch`."""
        return self._videos.watch(self._channel.robot, camera, AS_IT_IS, eye, first=True)


class TopicTap(ClientSubscription):
    """Takes every sample of a topic at once."""

    def __init__(self, clock: Clock, recorder: Recorder, topic: str) -> None:
        super().__init__(clock, recorder, topic)
        self._recorder = recorder

    def missed(self, count: int) -> None:
        """The recording lacks them."""
        self._recorder.missed(self.topic, count)

    def replay(self, sample: Sample) -> None:
        """A latched sample that came long ago: a recording must not seem to have begun then."""
        self._recorder.keep(self.topic, sample, self._recorder.not_before(sample.stamp))


class CameraTap:
    """Watches one camera as long as the recording runs, again when it could not be shown for a while."""

    def __init__(self, clock: Clock, recorder: Recorder, camera: str) -> None:
        self._clock = clock
        self._recorder = recorder
        self._camera = camera
        self._stream: CameraStream | None = None
        self._timer: Timer | None = None

    @property
    def user(self) -> int:
        """Whose it is."""
        return self._recorder.user

    def open(self) -> None:
        """Begin to watch.

        :raises Unavailable: too many do already
        """
        self.moved(self._recorder.watch(self._camera, self))

    def close(self) -> None:
        """Watch no more."""
        cancel(self._timer)
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.detach(self)

    def picture(self, picture: VideoFrameInfo) -> None:
        """Every one is recorded."""
        self._recorder.saw(self._camera, picture)

    def playing(self, playing: link.Playing) -> None:
        """Pictures say themselves how large they are, but not that they were to be larger or more."""
        if playing.reduced > 0:
            self._recorder.tell(
                "warning",
                f"{self._camera}: the robot's uplink is thin; for a while its pictures are smaller, coarser or fewer",
            )

        if playing.trouble:
            self._recorder.tell(
                "warning", f"{self._camera}: for a while no picture could be shown: {playing.trouble}"
            )

    def moved(self, stream: CameraStream) -> None:
        """Where the robot is at its limit what others watch is recorded, and that is told."""
        self._stream = stream
        other = differing(AS_IT_IS, stream.settings)
        if other:
            words = ", ".join(f"{name} {value}" for name, value in other.items())
            self._recorder.tell(
                "warning",
                f"{self._camera}: the robot is at its limit; for a while there are the pictures that others "
                f"asked for: {words}",
            )

    def ended(self, error: SwitchboardError) -> None:
        """It is not to be had at present."""
        self._stream = None
        self._recorder.tell("error", f"{self._camera}: {error}")
        self._timer = self._clock.callLater(AGAIN_SECONDS, self._again)

    def _again(self) -> None:
        try:
            self.open()
        except SwitchboardError as error:
            self.ended(error)


def _anew(converter: Converter) -> Callable[[bytes], bytes]:
    """A robot's own JSON, written anew: what is in the file is well-formed whatever came in."""
    return lambda body: converter.convert("json", body)
