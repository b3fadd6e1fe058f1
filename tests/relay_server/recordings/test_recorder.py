"""A recording from start to end, in a world in memory."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import Refused, Unavailable
from relay_protocol.frames import VideoFrame
from relay_protocol.rights import Grant, Level, Rules
from relay_server.access import Permit, Principal
from relay_server.channels.robot_clock import TYPE
from relay_server.recordings import recorder
from relay_server.recordings import recorder as module
from relay_server.recordings.library import RecordingEntry, RecordingState, why_denied
from relay_server.recordings.mcap_file import McapChannel, McapFile
from relay_server.recordings.recorder import HELD, RETRY_SECONDS, STAMPS_END, Recorder
from relay_server.recordings.writer import RecordedMessage, WriteOutcome
from tests.worlds import viewers as video
from tests.worlds.mcap_reader import read
from tests.worlds.relay import STRING, World, text
from tests.worlds.viewers import CAMERA, jpeg

HERE = "/chatter"


class MemoryWriter:
    """A writer that stores messages in a list."""

    def __init__(self, ended: Callable[[WriteOutcome], None]) -> None:
        self._ended = ended
        self.begun = self.closing = False
        self.room = 1000
        self.messages = 0
        self.bytes = 77
        self.broken = 0
        self.written: list[RecordedMessage] = []

    def start(self) -> None:
        assert not self.begun
        self.begun = True

    def put(self, message: RecordedMessage) -> bool:
        """Stores it."""
        if len(self.written) >= self.room:
            return False
        self.written.append(message)
        self.messages += 1
        return True

    def finish(self) -> None:
        """The recorder ends the file."""
        assert not self.closing
        self.closing = True

    def ends(self, finished: bool = True, reason: str = "") -> None:
        """The file has ended."""
        self._ended(WriteOutcome(finished, reason))

    @property
    def bodies(self) -> list[bytes]:
        """Bodies in the file."""
        return [each.body if each.make is None else each.make(each.body) for each in self.written]


class RecorderWorld:
    """A recorder with a user, a robot and a writer."""

    def __init__(
        self, world: World, topics: tuple[str, ...] = (HERE,), cameras: tuple[str, ...] = ()
    ) -> None:
        self.world = world
        what = "id", 1, "rover", 7, "ann", topics, cameras
        self.entry = RecordingEntry(*what, begun=1.0, limit=10**6, seconds=600.0, realm="main")
        principal = Principal(7, "ann", "main", False, 1, None)
        self.permit = Permit(principal, 1, Rules([Grant(Level.OPERATOR)]))
        self.over: list[Recorder] = []
        self.writers: list[MemoryWriter] = []
        self.saved: list[tuple[str, ...]] = []
        self.saving: list[Deferred[bool]] = []
        self.recorder = Recorder(
            world.clock,
            self.entry,
            self.permit,
            world.channel,
            world.videos,
            self._new_writer,  # type: ignore[arg-type]  # a writer without a file
            wall=lambda: 5.0,
            changed=self._save,
            ended=self.over.append,
        )

    def _new_writer(self, ended: Callable[[WriteOutcome], None]) -> MemoryWriter:
        self.writers.append(MemoryWriter(ended))
        return self.writers[-1]

    def _save(self, entry: RecordingEntry) -> Deferred[bool]:
        self.saved.append(entry.pictures)
        self.saving.append(Deferred())
        return self.saving[-1]

    def publishes_images(self, *topics: str) -> None:
        """The robot's graph lists exactly these topics of the recording as images."""
        reported = {}
        for topic in self.entry.topics:
            types = [STRING, "sensor_msgs/msg/Image"] if topic in topics else [STRING]
            reported[topic] = link.Topic(types=types, publishers=["/camera"])
        self.world.registry.graph(self.world.robot, link.Graph(topics=reported))

    @property
    def memory_writer(self) -> MemoryWriter:
        """The first writer."""
        return self.writers[0]

    def starts(self) -> None:
        """Starts the recording."""
        self.recorder.start()

    def received(self, encoding: str = "cdr") -> int:
        """The robot confirms the topic and sends its type; returns the subscription number."""
        number = self.world.link.all(link.Subscribe)[-1].number
        self.world.subscribed(number, encoding=encoding)
        if encoding == "cdr":
            self.world.define()
        return number

    def rights(self, *denied: str, level: Level = Level.OPERATOR) -> None:
        """Changes the rights."""
        self.permit.rules = Rules([Grant(level, (), denied)])
        self.permit.on_change()


def begun(world: World, encoding: str = "cdr") -> tuple[RecorderWorld, int]:
    """A recording of one topic of an online robot."""
    world.robot_comes((encoding,))
    scene = RecorderWorld(world)
    scene.starts()
    world.robot_joins()
    return scene, scene.received(encoding)


def test_samples_are_written_as_they_came(world: World) -> None:
    """With the robot's time, the type and its definition; no sample is missing."""
    scene, number = begun(world)
    assert world.link.all(link.Subscribe)[0].throttle_ms == 0
    for stamp in (5, 6, 7):
        world.channel.sample(number, text(f"{stamp}"), stamp)
    assert scene.memory_writer.bodies == [text("5"), text("6"), text("7")]
    assert [(each.log_time, each.publish_time) for each in scene.memory_writer.written] == [
        (5, 5),
        (6, 6),
        (7, 7),
    ]
    (track,) = {each.track for each in scene.memory_writer.written}
    assert track == McapChannel(HERE, STRING, "cdr", "string data\n")


def test_samples_of_a_robot_that_speaks_json_are_written_as_json(world: World) -> None:
    """They are decoded and encoded again, so that the file has only valid JSON."""
    scene, number = begun(world, "json")
    world.channel.sample(number, b' {"data":  "a"}', 5)
    world.channel.sample(number, b"no json", 6)
    assert scene.memory_writer.written[0].track == McapChannel(HERE, STRING, "json")
    first, second = scene.memory_writer.written
    assert first.make is not None and first.make(first.body) == b'{"data":"a"}'
    with pytest.raises(Exception, match="JSON"):
        assert second.make is not None and second.make(second.body)


def test_a_latched_sample_does_not_seem_to_have_come_long_ago(world: World) -> None:
    """Its log time is the start of the recording, and its publish time is the original one."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("subscribe", topic=HERE)
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, latched=True)
    world.define()
    world.channel.sample(number, text("old"), 5)
    scene = RecorderWorld(world)
    scene.starts()
    (message,) = scene.memory_writer.written
    assert (message.log_time, message.publish_time) == (world.channel.now_ns(), 5)
    assert message.track.latched


def test_a_robot_that_comes_back_goes_on_in_the_same_file(world: World) -> None:
    """With another subscription number, and another definition if it changed."""
    scene, number = begun(world)
    world.channel.sample(number, text("a"), 5)
    world.robot_goes()
    world.clock.advance(60)
    world.robot_comes()
    world.robot_joins()
    number = scene.received()
    world.channel.sample(number, text("b"), 6)
    assert scene.memory_writer.bodies == [text("a"), text("b")]
    assert scene.entry.state is RecordingState.RECORDING


def test_dropped_message_is_counted(world: World) -> None:
    """Samples that could not be converted are included."""
    scene, number = begun(world)
    scene.memory_writer.room = 2
    scene.memory_writer.broken = 1
    for _ in range(5):
        world.channel.sample(number, text("x"), 5)
    scene.recorder.count()
    assert (scene.entry.messages, scene.entry.drops, scene.entry.bytes) == (2, 4, 77)


def test_it_ends_when_its_time_is_over(world: World) -> None:
    """The robot's subscription ends, the file is closed, and no sample follows."""
    scene, number = begun(world)
    world.clock.advance(599)
    assert not scene.memory_writer.closing
    world.clock.advance(1)
    assert scene.memory_writer.closing
    assert scene.entry.state is RecordingState.FINISHING
    assert world.link.all(link.Unsubscribe) == [link.Unsubscribe(number=number)]
    scene.recorder.stop("too late")
    assert scene.over == []
    scene.memory_writer.ends()
    assert scene.over == [scene.recorder]
    assert (scene.entry.state, scene.entry.reason) == (RecordingState.COMPLETE, "its time is over")
    assert scene.entry.ended == 5.0
    world.clock.advance(10)
    assert world.channel.state.value == "new", "the channel has closed, and this is another one"


def test_it_ends_when_the_writer_does(world: World) -> None:
    """At the size limit, or when the disk is full."""
    scene, _ = begun(world)
    scene.memory_writer.ends(True, "it has reached its size limit")
    assert (scene.entry.state, scene.entry.reason) == (
        RecordingState.COMPLETE,
        "it has reached its size limit",
    )
    assert not world.channel.members
    other = RecorderWorld(world)
    other.starts()
    other.memory_writer.ends(False, "the disk is full")
    assert (other.entry.state, other.entry.reason) == (RecordingState.INCOMPLETE, "the disk is full")


@pytest.mark.parametrize("denied", ["record:/chatter", "subscribe:/chatter", "*:*"])
def test_it_ends_with_the_right(world: World, denied: str) -> None:
    """The right to record, or to subscribe to a recorded topic; other rights do not matter."""
    scene, number = begun(world)
    scene.rights("record:/other", "publish:*")
    assert not scene.memory_writer.closing
    scene.rights(denied)
    assert scene.memory_writer.closing
    assert denied in scene.entry.reason
    world.channel.sample(number, text("x"), 5)
    assert scene.memory_writer.written == []


def test_a_recording_ends_when_its_user_loses_all_rights(world: World) -> None:
    """By a logout, or because the robot was removed."""
    scene, _ = begun(world)
    scene.permit.on_revoke(Refused("your right on this robot was revoked"))
    assert scene.memory_writer.closing
    assert scene.entry.reason == "your right on this robot was revoked"


def test_rights_of_a_viewer_are_not_enough(world: World) -> None:
    """A topic that the user may not subscribe to cannot be recorded either."""
    scene = RecorderWorld(world, (HERE,), (CAMERA,))
    assert why_denied(scene.permit, scene.entry) == ""
    scene.rights(level=Level.VIEWER)
    assert "needs the level operator" in why_denied(scene.permit, scene.entry)
    for denied in (f"view:{CAMERA}", f"record:{CAMERA}", "subscribe:/chatter"):
        scene.rights(denied)
        assert denied in why_denied(scene.permit, scene.entry)


def test_recordings_of_another_realm_are_not_found(world: World) -> None:
    """The robot belongs to both realms, and the user may see it."""
    scene = RecorderWorld(world, (HERE,))
    scene.entry.realm = "lab2"
    assert why_denied(scene.permit, scene.entry) == "it was recorded in another realm"


def test_images_of_a_topic_take_the_right_to_view_them(world: World) -> None:
    """A topic that begins to carry images ends the recording, unless its user may view them."""
    scene, _ = begun(world)
    scene.rights(f"view:{HERE}")
    assert scene.entry.state is RecordingState.RECORDING
    reported = link.Graph(topics={HERE: link.Topic(types=["sensor_msgs/msg/Image"], publishers=["/camera"])})
    world.registry.graph(world.robot, reported)
    assert scene.memory_writer.closing
    assert "view on /chatter is denied" in scene.entry.reason
    assert scene.entry.pictures == (HERE,)
    assert "view on /chatter is denied" in why_denied(scene.permit, scene.entry)


def test_images_are_written_when_it_is_on_record_that_they_are(world: World) -> None:
    """If the relay is killed at any time, the file's readers are known; images that arrived meanwhile are
    kept.
    """
    scene, number = begun(world)
    world.channel.sample(number, text("a"), 5)
    assert scene.saved == []
    scene.publishes_images(HERE)
    assert scene.saved == [(HERE,)]
    for stamp in (6, 7):
        world.channel.sample(number, text("b"), stamp)
    scene.publishes_images(HERE)
    assert (scene.memory_writer.bodies, len(scene.saved)) == ([text("a")], 1)
    scene.saving[0].callback(True)
    assert scene.memory_writer.bodies == [text("a"), text("b"), text("b")]
    assert [each.log_time for each in scene.memory_writer.written] == [5, 6, 7]
    world.channel.sample(number, text("c"), 8)
    scene.publishes_images(HERE)
    scene.publishes_images()
    assert (scene.memory_writer.bodies[3:], len(scene.saved), scene.entry.pictures) == (
        [text("c")],
        1,
        (HERE,),
    )
    scene.recorder.count()
    assert scene.entry.drops == 0


def test_topics_found_one_after_the_other_are_all_put_on_record(world: World) -> None:
    """The second topic is found while the first is being saved, so it is saved next."""
    other = "/map"
    world.robot_comes()
    scene = RecorderWorld(world, (HERE, other))
    scene.publishes_images()
    scene.starts()
    world.robot_joins()
    number = scene.received()
    scene.publishes_images(HERE)
    scene.publishes_images(HERE, other)
    world.channel.sample(number, text("a"), 5)
    assert scene.saved == [(HERE,)]
    scene.saving[0].callback(True)
    assert scene.saved == [(HERE,), (HERE, other)]
    assert scene.memory_writer.written == []
    scene.saving[1].callback(True)
    assert scene.memory_writer.bodies == [text("a")]


def test_failed_audit_entry_is_retried(world: World) -> None:
    """No images are written until it succeeds; the recording reports and counts the missing ones."""
    scene, number = begun(world)
    scene.publishes_images(HERE)
    for _ in range(HELD + 2):
        world.channel.sample(number, text("a"), 5)
    for _ in range(3):
        scene.saving[-1].callback(False)
        world.clock.advance(RETRY_SECONDS)
    assert (len(scene.saved), scene.memory_writer.written) == (4, [])
    assert any("could not be saved" in each for each in scene.entry.problems)
    assert any("were lost while the recording waited" in each for each in scene.entry.problems)
    scene.saving[-1].callback(True)
    scene.recorder.count()
    assert (len(scene.memory_writer.written), scene.entry.drops) == (HELD, 2)


def test_images_that_wait_take_little_memory(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """For any size of the images."""
    monkeypatch.setattr(module, "HELD_BYTES", 2 * len(text("a")))
    scene, number = begun(world)
    scene.publishes_images(HERE)
    for _ in range(3):
        world.channel.sample(number, text("a"), 5)
    scene.saving[0].callback(True)
    scene.recorder.count()
    assert (len(scene.memory_writer.written), scene.entry.drops) == (2, 1)


@pytest.mark.parametrize("saved", [True, False])
def test_a_recording_that_is_over_writes_nothing_that_waited(world: World, saved: bool) -> None:
    """It makes no audit entry for them either, since its end makes one."""
    scene, number = begun(world)
    scene.publishes_images(HERE)
    world.channel.sample(number, text("a"), 5)
    scene.recorder.stop("enough")
    scene.saving[0].callback(saved)
    world.clock.advance(RETRY_SECONDS)
    scene.memory_writer.ends()
    assert (scene.memory_writer.written, scene.entry.drops, len(scene.saved)) == ([], 1, 1)


def test_images_that_began_while_it_was_begun_are_found(world: World) -> None:
    """Between the request and the start a file was written, and the robot reported another type meanwhile."""
    world.robot_comes()
    scene = RecorderWorld(world)
    scene.publishes_images(HERE)
    scene.starts()
    assert scene.saved == [(HERE,)]
    other = RecorderWorld(world)
    other.rights(f"view:{HERE}")
    other.starts()
    assert other.memory_writer.closing
    assert "view on /chatter is denied" in other.entry.reason


def test_a_topic_that_is_not_there_is_recorded_when_it_comes(world: World) -> None:
    """Until then it is a problem. The others are recorded meanwhile."""
    world.at_work()
    scene = RecorderWorld(world, (HERE, "/later", "/nowhere"))
    scene.starts()
    world.channel.sample(scene.received(), text("a"), 5)
    waiting = "these topics do not exist yet, and are recorded when they come: "
    assert scene.entry.problems == [waiting + "/later, /nowhere"]
    later = link.Topic(types=[STRING], publishers=["/node"])
    world.registry.graph(world.robot, link.Graph(topics={"/later": later}))
    assert scene.entry.problems == [waiting + "/nowhere"]
    assert world.link.all(link.Subscribe)[-1].topic == "/later"
    world.channel.sample(scene.received(), text("b"), 6)
    assert [(each.track.topic, each.body) for each in scene.memory_writer.written] == [
        (HERE, text("a")),
        ("/later", text("b")),
    ]
    scene.recorder.stop("enough")
    assert scene.entry.problems == ["these topics did not exist while it was recorded: /nowhere"]


def test_a_topic_that_was_not_there_when_the_robot_came_is_a_problem_too(world: World) -> None:
    """The recording has begun while the robot was offline."""
    scene = RecorderWorld(world, tuple(f"/nowhere{number}" for number in range(12)))
    scene.starts()
    assert scene.entry.problems == []
    world.robot_comes()
    world.robot_joins()
    world.registry.graph(world.robot, link.Graph(topics={HERE: None}))
    (problem,) = scene.entry.problems
    assert problem.startswith("these topics do not exist yet, and are recorded when they come: /nowhere0, ")
    assert problem.endswith("/nowhere9 and 2 more")


def test_a_topic_that_comes_with_images_takes_the_right_to_view_them(world: World) -> None:
    """Nothing of it is requested from the robot without that right."""
    world.at_work()
    scene = RecorderWorld(world, ("/later",))
    scene.rights("view:/later")
    scene.starts()
    images = link.Topic(types=["sensor_msgs/msg/Image"], publishers=["/camera"])
    world.registry.graph(world.robot, link.Graph(topics={"/later": images}))
    assert "view on /later is denied" in scene.entry.reason
    assert world.link.all(link.Subscribe) == []


def test_a_clock_that_jumps_is_a_problem(world: World) -> None:
    """Back or forward, once for each jump. A sample that arrives late is none."""
    scene, number = begun(world)
    second = 10**9
    world.channel.sample(number, text("a"), 100 * second)
    world.clock.advance(5)
    world.channel.sample(number, text("late"), 101 * second)
    world.clock.advance(0.1)
    world.channel.sample(number, text("b"), 105 * second)
    assert scene.entry.problems == []
    for stamp in (90, 91, 4000, 4001):
        world.clock.advance(1)
        world.channel.sample(number, text("c"), stamp * second)
    words = "times before and after it do not compare"
    assert scene.entry.problems == [
        f"the robot's clock jumped back by 15 s; {words}",
        f"the robot's clock jumped forward by 3908 s; {words}",
    ]
    assert len(scene.memory_writer.written) == 7


def test_a_clock_that_jumps_is_seen_by_a_camera_alone(world: World) -> None:
    """The stamps of its frames are of the robot's clock."""
    video.robot_comes(world)
    scene = RecorderWorld(world, (), (CAMERA,))
    scene.starts()
    video.robot_joins(world)
    (stream,) = world.videos.streams_of(world.robot)
    for number, stamp in enumerate((100, 101, 40, 41), 1):
        world.clock.advance(1)
        stream.frame_received(VideoFrame(number, stamp * 10**9, jpeg()))
    assert [each.partition(";")[0] for each in scene.entry.problems] == [
        "the robot's clock jumped back by 61 s"
    ]


def test_simulated_time_that_jumps_is_a_problem(world: World) -> None:
    """Back or forward. A simulation that is fast does not jump, and a jump after the end changes nothing."""
    listeners = world.channel.robot_clock.on_jump
    world.robot_comes()
    world.registry.described(world.robot, msgspec.structs.replace(world.robot.description, sim_time=True))
    scene = RecorderWorld(world)
    scene.starts()
    world.robot_joins()
    (asked,) = [each for each in world.link.all(link.Subscribe) if each.topic == "/clock"]
    world.channel.message(
        link.Subscribed(number=asked.number, topic="/clock", type=TYPE, encoding="cdr", publishers=1)
    )

    def tick(seconds: int) -> None:
        world.channel.sample(asked.number, b"\0\1\0\0" + struct.pack("<iI", seconds, 0), 0)

    for seconds in (50, 51, 3, 8, 13, 600, 601):
        tick(seconds)
        world.clock.advance(0.1)
    words = "times before and after it do not compare"
    assert scene.entry.problems == [
        f"the robot's simulated time jumped back by 48 s; {words}",
        f"the robot's simulated time jumped forward by 587 s; {words}",
    ]
    assert len(listeners) == 1
    scene.recorder.stop("enough")
    assert listeners == []


def test_the_reason_of_a_missing_topic_is_stored_with_the_recording(world: World) -> None:
    """Each reason is stored once."""
    world.robot_comes()
    scene = RecorderWorld(world)
    scene.starts()
    world.robot_joins()
    number = world.link.all(link.Subscribe)[0].number
    for _ in range(3):
        world.channel.message(link.Failed(request="subscribe", reference=str(number), reason="no such luck"))
    assert scene.entry.problems == ["subscribe /chatter: no such luck"]


def test_images_are_written_as_messages(world: World) -> None:
    """Each with its capture time."""
    video.robot_comes(world)
    scene = RecorderWorld(world, (), (CAMERA,))
    scene.starts()
    video.robot_joins(world)
    (stream,) = world.videos.streams_of(world.robot)
    assert stream.settings == link.VideoSettings()
    for number in (1, 2):
        video.shows(world, stream, number)
    first, second = scene.memory_writer.written
    assert first.track == McapChannel(f"{CAMERA}/compressed", recorder.TYPE, "cdr", recorder.TEXT)
    assert first.log_time == first.publish_time
    assert scene.memory_writer.bodies[0] == recorder.message(jpeg(), first.log_time, "jpeg")
    assert second.log_time >= first.log_time
    scene.recorder.stop("enough")
    assert not stream.viewers


@pytest.mark.parametrize("stamp", [2**31 * 10**9, 2**63, 2**64 - 1])
def test_a_clock_that_can_not_be_breaks_nothing(world: World, stamp: int, tmp_path: Path) -> None:
    """A capture time that ROS cannot express is replaced by the time of arrival. This is reported once, and
    the file is valid.
    """
    video.robot_comes(world)
    scene = RecorderWorld(world, (), (CAMERA,))
    scene.starts()
    video.robot_joins(world)
    (stream,) = world.videos.streams_of(world.robot)
    for number in (1, 2):
        stream.frame_received(VideoFrame(number, stamp, jpeg()))
    now = world.channel.now_ns()
    assert [(each.log_time, each.publish_time) for each in scene.memory_writer.written] == [(now, now)] * 2
    assert scene.memory_writer.bodies[0] == recorder.message(jpeg(), now, "jpeg")
    assert [each.partition(":")[0] for each in scene.entry.problems] == [CAMERA]
    with (tmp_path / "a.mcap").open("wb") as file:
        mcap = McapFile(file, 10**7, ros=True)
        for message, body in zip(scene.memory_writer.written, scene.memory_writer.bodies, strict=True):
            mcap.add(message.track, message.log_time, message.publish_time, body)
        mcap.finish()
    assert len(read(tmp_path / "a.mcap")) == 2


@pytest.mark.parametrize("stamp", [STAMPS_END, 2**64 - 1])
def test_a_sample_of_a_clock_that_can_not_be_has_the_time_it_came(world: World, stamp: int) -> None:
    """Otherwise players would wait for centuries."""
    scene, number = begun(world)
    for _ in range(2):
        world.channel.sample(number, text("a"), stamp)
    now = world.channel.now_ns()
    assert [(each.log_time, each.publish_time) for each in scene.memory_writer.written] == [(now, now)] * 2
    assert [each.partition(":")[0] for each in scene.entry.problems] == [HERE]


def test_the_latest_possible_time_is_stored(world: World) -> None:
    """It is in January 2038."""
    scene, number = begun(world)
    world.channel.sample(number, text("a"), STAMPS_END - 1)
    assert scene.memory_writer.written[0].log_time == STAMPS_END - 1
    assert scene.entry.problems == []


def test_a_latched_sample_of_a_clock_that_can_not_be_comes_now(world: World) -> None:
    """Both of its times are the time of arrival."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("subscribe", topic=HERE)
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, latched=True)
    world.define()
    world.channel.sample(number, text("old"), 2**64 - 1)
    scene = RecorderWorld(world)
    scene.starts()
    (message,) = scene.memory_writer.written
    assert message.log_time == message.publish_time == world.channel.now_ns()


def test_recording_of_other_images_is_reported(world: World) -> None:
    """The robot is at its limit of streams; when one is free, the requested images are recorded."""
    video.robot_comes(world, streams=1)
    viewer = video.Watcher(1)
    stream = viewer.watch(world, link.VideoSettings(width=32, quality=60))
    video.robot_joins(world)
    video.shows(world, stream, 1)
    scene = RecorderWorld(world, (), (CAMERA,))
    scene.starts()
    video.shows(world, stream, 2)
    (problem,) = scene.entry.problems
    assert problem.startswith(f"{CAMERA}: the robot is at its limit")
    assert problem.endswith("width 32, quality 60")
    viewer.leave()
    video.robot_joins(world)
    (own,) = world.videos.streams_of(world.robot)
    assert own.settings == link.VideoSettings()
    video.shows(world, own, 1)
    assert len(scene.memory_writer.written) == 2
    assert scene.entry.problems == [problem]


def test_reduction_of_images_is_reported(world: World) -> None:
    """Once per camera."""
    video.robot_comes(world)
    scene = RecorderWorld(world, (), (CAMERA,))
    scene.starts()
    video.robot_joins(world)
    (stream,) = world.videos.streams_of(world.robot)
    stream.message_received(link.StreamStatus(width=640, height=480, quality=80))
    assert scene.entry.problems == []
    for reduced in (0.5, 0.0, 0.25):
        world.clock.advance(1)
        stream.message_received(link.StreamStatus(width=32, height=24, quality=40, reduced=reduced))
    (problem,) = scene.entry.problems
    assert problem.startswith(f"{CAMERA}: the robot's uplink is slow")


def test_damaged_images_are_counted_as_drops(world: World) -> None:
    """Those of before are not; a new link counts from 0."""
    video.robot_comes(world)
    scene = RecorderWorld(world, (), (CAMERA,))
    scene.starts()
    video.robot_joins(world)
    (stream,) = world.videos.streams_of(world.robot)
    for damaged in (0, 2, 2, 5, 1):
        world.clock.advance(1)
        stream.message_received(link.StreamStatus(width=640, height=480, quality=80, damaged=damaged))
    scene.recorder.count()
    assert scene.entry.drops == 6
    assert scene.entry.problems == [f"{CAMERA}: frames were left out because they are damaged"]


def test_a_camera_that_is_not_to_be_had_is_asked_for_again(world: World) -> None:
    """As long as the recording runs; the reason is stored."""
    video.robot_comes(world)
    scene = RecorderWorld(world, (), (CAMERA,))
    scene.starts()
    video.robot_joins(world)
    (stream,) = world.videos.streams_of(world.robot)
    stream.close(Unavailable("the lens is covered"))
    assert scene.entry.problems == [f"{CAMERA}: the lens is covered"]
    world.clock.advance(RETRY_SECONDS)
    (stream,) = world.videos.streams_of(world.robot)
    stream.close(Unavailable("the lens is covered"))
    scene.recorder.stop("enough")
    world.clock.advance(RETRY_SECONDS)
    assert world.videos.streams_of(world.robot) == []
