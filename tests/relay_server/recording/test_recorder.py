"""One recording while it runs, in a world in memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import Invalid, Refused, Unavailable
from relay_protocol.frames import VideoFrame
from relay_protocol.rights import Grant, Level, Rules
from relay_server.access import Permit, Principal
from relay_server.recordings import recorder
from relay_server.recordings import recorder as module
from relay_server.recordings.library import RecordingEntry, RecordingState
from relay_server.recordings.mcap_file import McapChannel, McapFile
from relay_server.recordings.recorder import AGAIN_SECONDS, HELD, STAMPS_END, Recorder
from relay_server.recordings.rights import why_denied
from relay_server.recordings.writer import RecordedMessage, WriteOutcome
from tests.relay_server.memory import STRING, World, text
from tests.relay_server.recording.reading import read
from tests.relay_server.video import watching as video
from tests.relay_server.video.watching import CAMERA, jpeg

HERE = "/chatter"


class Paper:
    """A writer that keeps what it is given."""

    def __init__(self, ended: Callable[[WriteOutcome], None]) -> None:
        self._ended = ended
        self.begun = self.closing = False
        self.room = 1000
        self.messages = 0
        self.bytes = 77
        self.broken = 0
        self.written: list[RecordedMessage] = []

    def start(self) -> None:
        """Begin."""
        assert not self.begun
        self.begun = True

    def put(self, message: RecordedMessage) -> bool:
        """Keep it."""
        if len(self.written) >= self.room:
            return False
        self.written.append(message)
        self.messages += 1
        return True

    def finish(self) -> None:
        """It is told to end."""
        assert not self.closing
        self.closing = True

    def ends(self, finished: bool = True, reason: str = "") -> None:
        """It has ended."""
        self._ended(WriteOutcome(finished, reason))

    @property
    def bodies(self) -> list[bytes]:
        """What stands in the file."""
        return [each.body if each.make is None else each.make(each.body) for each in self.written]


class Desk:
    """Who records what, and what becomes of it."""

    def __init__(
        self, world: World, topics: tuple[str, ...] = (HERE,), cameras: tuple[str, ...] = ()
    ) -> None:
        self.world = world
        what = "id", 1, "rover", 7, "ann", topics, cameras
        self.entry = RecordingEntry(*what, begun=1.0, limit=10**6, seconds=600.0, realm="main")
        principal = Principal(7, "ann", "main", False, 1, None)
        self.permit = Permit(principal, 1, Rules([Grant(Level.OPERATOR)]))
        self.over: list[Recorder] = []
        self.papers: list[Paper] = []
        self.saved: list[tuple[str, ...]] = []
        self.saving: list[Deferred[bool]] = []
        self.recorder = Recorder(
            world.clock,
            self.entry,
            self.permit,
            world.channel,
            world.videos,
            self._paper,  # type: ignore[arg-type]  # a writer without a file
            wall=lambda: 5.0,
            changed=self._save,
            ended=self.over.append,
        )

    def _paper(self, ended: Callable[[WriteOutcome], None]) -> Paper:
        self.papers.append(Paper(ended))
        return self.papers[-1]

    def _save(self, entry: RecordingEntry) -> Deferred[bool]:
        self.saved.append(entry.pictures)
        self.saving.append(Deferred())
        return self.saving[-1]

    def shows_pictures(self, *topics: str) -> None:
        """The robot tells that these topics carry pictures too now, and none of the others does."""
        told = {}
        for topic in self.entry.topics:
            types = [STRING, "sensor_msgs/msg/Image"] if topic in topics else [STRING]
            told[topic] = link.Topic(types=types, publishers=["/eye"])
        self.world.registry.graph(self.world.robot, link.Graph(topics=told))

    @property
    def paper(self) -> Paper:
        """What is written on."""
        return self.papers[0]

    def starts(self) -> None:
        """It begins."""
        self.recorder.start()

    def hears(self, encoding: str = "cdr") -> int:
        """The robot confirms the topic and tells its type; the number of the topic."""
        number = self.world.link.all(link.Subscribe)[-1].number
        self.world.subscribed(number, encoding=encoding)
        if encoding == "cdr":
            self.world.define()
        return number

    def rights(self, *denied: str, level: Level = Level.OPERATOR) -> None:
        """The rights change."""
        self.permit.rules = Rules([Grant(level, (), denied)])
        self.permit.on_change()


def begun(world: World, encoding: str = "cdr") -> tuple[Desk, int]:
    """A recording of one topic of a robot that is there."""
    world.robot_comes((encoding,))
    desk = Desk(world)
    desk.starts()
    world.robot_joins()
    return desk, desk.hears(encoding)


def test_samples_are_written_as_they_came(world: World) -> None:
    """With the robot's time, the type and its definition; no sample is left out."""
    desk, number = begun(world)
    assert world.link.all(link.Subscribe)[0].throttle_ms == 0
    for stamp in (5, 6, 7):
        world.channel.sample(number, text(f"{stamp}"), stamp)
    assert desk.paper.bodies == [text("5"), text("6"), text("7")]
    assert [(each.log_time, each.publish_time) for each in desk.paper.written] == [(5, 5), (6, 6), (7, 7)]
    (track,) = {each.track for each in desk.paper.written}
    assert track == McapChannel(HERE, STRING, "cdr", "string data\n")


def test_samples_of_a_robot_that_speaks_json_are_written_as_json(world: World) -> None:
    """Anew, so that no robot writes what is not JSON into the file."""
    desk, number = begun(world, "json")
    world.channel.sample(number, b' {"data":  "a"}', 5)
    world.channel.sample(number, b"no json", 6)
    assert desk.paper.written[0].track == McapChannel(HERE, STRING, "json")
    first, second = desk.paper.written
    assert first.make is not None and first.make(first.body) == b'{"data":"a"}'
    with pytest.raises(Exception, match="JSON"):
        assert second.make is not None and second.make(second.body)


def test_a_latched_sample_does_not_seem_to_have_come_long_ago(world: World) -> None:
    """It stands at the beginning of the recording, and says when it was published."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("subscribe", topic=HERE)
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, latched=True)
    world.define()
    world.channel.sample(number, text("old"), 5)
    desk = Desk(world)
    desk.starts()
    (message,) = desk.paper.written
    assert (message.log_time, message.publish_time) == (world.channel.now_ns(), 5)
    assert message.track.latched


def test_a_robot_that_comes_back_goes_on_in_the_same_file(world: World) -> None:
    """With another number and another definition, if it has one."""
    desk, number = begun(world)
    world.channel.sample(number, text("a"), 5)
    world.robot_goes()
    world.clock.advance(60)
    world.robot_comes()
    world.robot_joins()
    number = desk.hears()
    world.channel.sample(number, text("b"), 6)
    assert desk.paper.bodies == [text("a"), text("b")]
    assert desk.entry.state is RecordingState.RECORDING


def test_what_finds_no_room_is_counted(world: World) -> None:
    """With what could not be made into a message."""
    desk, number = begun(world)
    desk.paper.room = 2
    desk.paper.broken = 1
    for _ in range(5):
        world.channel.sample(number, text("x"), 5)
    desk.recorder.count()
    assert (desk.entry.messages, desk.entry.drops, desk.entry.bytes) == (2, 4, 77)


def test_it_ends_when_its_time_is_over(world: World) -> None:
    """The robot is told that nobody listens, the file is finished, and nothing more comes."""
    desk, number = begun(world)
    world.clock.advance(599)
    assert not desk.paper.closing
    world.clock.advance(1)
    assert desk.paper.closing
    assert desk.entry.state is RecordingState.FINISHING
    assert world.link.all(link.Unsubscribe) == [link.Unsubscribe(number=number)]
    desk.recorder.stop("too late")
    assert desk.over == []
    desk.paper.ends()
    assert desk.over == [desk.recorder]
    assert (desk.entry.state, desk.entry.reason) == (RecordingState.COMPLETE, "it has taken its time")
    assert desk.entry.ended == 5.0
    world.clock.advance(10)
    assert world.channel.state.value == "new", "the channel has closed, and this is another one"


def test_it_ends_when_the_writer_does(world: World) -> None:
    """At its size, or when the disk is full."""
    desk, _ = begun(world)
    desk.paper.ends(True, "it has reached its size")
    assert (desk.entry.state, desk.entry.reason) == (RecordingState.COMPLETE, "it has reached its size")
    assert not world.channel.members
    other = Desk(world)
    other.starts()
    other.paper.ends(False, "the disk is full")
    assert (other.entry.state, other.entry.reason) == (RecordingState.INCOMPLETE, "the disk is full")


@pytest.mark.parametrize("denied", ["record:/chatter", "subscribe:/chatter", "*:*"])
def test_it_ends_with_the_right(world: World, denied: str) -> None:
    """To record, or to subscribe to what is recorded; a right on anything else may go."""
    desk, number = begun(world)
    desk.rights("record:/other", "publish:*")
    assert not desk.paper.closing
    desk.rights(denied)
    assert desk.paper.closing
    assert denied in desk.entry.reason
    world.channel.sample(number, text("x"), 5)
    assert desk.paper.written == []


def test_it_ends_when_who_records_may_nothing_any_more(world: World) -> None:
    """Logged out, or the robot was removed."""
    desk, _ = begun(world)
    desk.permit.on_revoke(Refused("your right on this robot was revoked"))
    assert desk.paper.closing
    assert desk.entry.reason == "your right on this robot was revoked"


def test_what_a_viewer_may_is_not_enough(world: World) -> None:
    """Nor to record what may not be seen."""
    desk = Desk(world, (HERE,), (CAMERA,))
    assert why_denied(desk.permit, desk.entry) == ""
    desk.rights(level=Level.VIEWER)
    assert "needs the level operator" in why_denied(desk.permit, desk.entry)
    for denied in (f"view:{CAMERA}", f"record:{CAMERA}", "subscribe:/chatter"):
        desk.rights(denied)
        assert denied in why_denied(desk.permit, desk.entry)


def test_what_another_realm_has_recorded_is_not_had(world: World) -> None:
    """Of a robot that both are at, whatever one may see of it."""
    desk = Desk(world, (HERE,))
    desk.entry.realm = "lab2"
    assert why_denied(desk.permit, desk.entry) == "it was recorded in another realm"


def test_pictures_of_a_topic_take_the_right_to_view_them(world: World) -> None:
    """A topic that begins to carry some ends the recording, which is the business of who may view from then on."""
    desk, _ = begun(world)
    desk.rights(f"view:{HERE}")
    assert desk.entry.state is RecordingState.RECORDING
    told = link.Graph(topics={HERE: link.Topic(types=["sensor_msgs/msg/Image"], publishers=["/eye"])})
    world.registry.graph(world.robot, told)
    assert desk.paper.closing
    assert "view on /chatter is denied" in desk.entry.reason
    assert desk.entry.pictures == (HERE,)
    assert "view on /chatter is denied" in why_denied(desk.permit, desk.entry)


def test_pictures_are_written_when_it_is_on_record_that_they_are(world: World) -> None:
    """If the relay is killed at any time, who may have the file is known; what came meanwhile is not lost."""
    desk, number = begun(world)
    world.channel.sample(number, text("a"), 5)
    assert desk.saved == []
    desk.shows_pictures(HERE)
    assert desk.saved == [(HERE,)]
    for stamp in (6, 7):
        world.channel.sample(number, text("b"), stamp)
    desk.shows_pictures(HERE)
    assert (desk.paper.bodies, len(desk.saved)) == ([text("a")], 1)
    desk.saving[0].callback(True)
    assert desk.paper.bodies == [text("a"), text("b"), text("b")]
    assert [each.log_time for each in desk.paper.written] == [5, 6, 7]
    world.channel.sample(number, text("c"), 8)
    desk.shows_pictures(HERE)
    desk.shows_pictures()
    assert (desk.paper.bodies[3:], len(desk.saved), desk.entry.pictures) == ([text("c")], 1, (HERE,))
    desk.recorder.count()
    assert desk.entry.drops == 0


def test_topics_found_one_after_the_other_are_all_put_on_record(world: World) -> None:
    """What is being saved does not know of the second, so that one waits for the next time."""
    other = "/map"
    world.robot_comes()
    desk = Desk(world, (HERE, other))
    desk.shows_pictures()
    desk.starts()
    world.robot_joins()
    number = desk.hears()
    desk.shows_pictures(HERE)
    desk.shows_pictures(HERE, other)
    world.channel.sample(number, text("a"), 5)
    assert desk.saved == [(HERE,)]
    desk.saving[0].callback(True)
    assert desk.saved == [(HERE,), (HERE, other)]
    assert desk.paper.written == []
    desk.saving[1].callback(True)
    assert desk.paper.bodies == [text("a")]


def test_what_can_not_be_put_on_record_is_tried_again(world: World) -> None:
    """No pictures are written until it is; that they are missing is told, and they are counted."""
    desk, number = begun(world)
    desk.shows_pictures(HERE)
    for _ in range(HELD + 2):
        world.channel.sample(number, text("a"), 5)
    for _ in range(3):
        desk.saving[-1].callback(False)
        world.clock.advance(AGAIN_SECONDS)
    assert (len(desk.saved), desk.paper.written) == (4, [])
    assert any("could not be put on record" in each for each in desk.entry.problems)
    assert any("were lost while the recording waited" in each for each in desk.entry.problems)
    desk.saving[-1].callback(True)
    desk.recorder.count()
    assert (len(desk.paper.written), desk.entry.drops) == (HELD, 2)


def test_pictures_that_wait_take_little_memory(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """However large each of them is."""
    monkeypatch.setattr(module, "HELD_BYTES", 2 * len(text("a")))
    desk, number = begun(world)
    desk.shows_pictures(HERE)
    for _ in range(3):
        world.channel.sample(number, text("a"), 5)
    desk.saving[0].callback(True)
    desk.recorder.count()
    assert (len(desk.paper.written), desk.entry.drops) == (2, 1)


@pytest.mark.parametrize("saved", [True, False])
def test_a_recording_that_is_over_writes_nothing_that_waited(world: World, saved: bool) -> None:
    """Nor does it try to put anything on record; that is done at its end."""
    desk, number = begun(world)
    desk.shows_pictures(HERE)
    world.channel.sample(number, text("a"), 5)
    desk.recorder.stop("enough")
    desk.saving[0].callback(saved)
    world.clock.advance(AGAIN_SECONDS)
    desk.paper.ends()
    assert (desk.paper.written, desk.entry.drops, len(desk.saved)) == ([], 1, 1)


def test_pictures_that_began_while_it_was_begun_are_found(world: World) -> None:
    """Between the wish and the beginning a file was written, and meanwhile the robot told of another type."""
    world.robot_comes()
    desk = Desk(world)
    desk.shows_pictures(HERE)
    desk.starts()
    assert desk.saved == [(HERE,)]
    other = Desk(world)
    other.rights(f"view:{HERE}")
    other.starts()
    assert other.paper.closing
    assert "view on /chatter is denied" in other.entry.reason


def test_a_topic_that_is_not_there_is_refused_and_nothing_has_begun(world: World) -> None:
    """The robot is asked for nothing."""
    world.at_work()
    desk = Desk(world, (HERE, "/nowhere"))
    with pytest.raises(Invalid, match="/nowhere does not exist"):
        desk.starts()
    assert desk.recorder not in world.channel.members
    assert world.link.all(link.Subscribe)[-1].topic == HERE
    assert len(world.link.all(link.Unsubscribe)) == 1
    assert not desk.paper.begun


def test_why_a_topic_does_not_come_is_kept_with_the_recording(world: World) -> None:
    """Once for each reason."""
    world.robot_comes()
    desk = Desk(world)
    desk.starts()
    world.robot_joins()
    number = world.link.all(link.Subscribe)[0].number
    for _ in range(3):
        world.channel.message(link.Failed(what="subscribe", ref=str(number), reason="no such luck"))
    assert desk.entry.problems == ["subscribe /chatter: no such luck"]


def test_pictures_are_written_as_messages(world: World) -> None:
    """Each with the time it was taken."""
    video.robot_comes(world)
    desk = Desk(world, (), (CAMERA,))
    desk.starts()
    video.robot_joins(world)
    (stream,) = world.videos.of(world.robot)
    assert stream.settings == link.VideoSettings()
    for number in (1, 2):
        video.shows(world, stream, number)
    first, second = desk.paper.written
    assert first.track == McapChannel(f"{CAMERA}/compressed", recorder.TYPE, "cdr", recorder.TEXT)
    assert first.log_time == first.publish_time
    assert desk.paper.bodies[0] == recorder.message(jpeg(), first.log_time, "jpeg")
    assert second.log_time >= first.log_time
    desk.recorder.stop("enough")
    assert not stream.viewers


@pytest.mark.parametrize("stamp", [2**31 * 10**9, 2**63, 2**64 - 1])
def test_a_clock_that_can_not_be_breaks_nothing(world: World, stamp: int, tmp_path: Path) -> None:
    """A picture's time that ROS can't hold is replaced by when it came; that is told once, and the file is whole."""
    video.robot_comes(world)
    desk = Desk(world, (), (CAMERA,))
    desk.starts()
    video.robot_joins(world)
    (stream,) = world.videos.of(world.robot)
    for number in (1, 2):
        stream.picture(VideoFrame(number, stamp, jpeg()))
    now = world.channel.now_ns()
    assert [(each.log_time, each.publish_time) for each in desk.paper.written] == [(now, now)] * 2
    assert desk.paper.bodies[0] == recorder.message(jpeg(), now, "jpeg")
    assert [each.partition(":")[0] for each in desk.entry.problems] == [CAMERA]
    with (tmp_path / "a.mcap").open("wb") as file:
        book = McapFile(file, 10**7, ros=True)
        for message, body in zip(desk.paper.written, desk.paper.bodies, strict=True):
            book.add(message.track, message.log_time, message.publish_time, body)
        book.finish()
    assert len(read(tmp_path / "a.mcap")) == 2


@pytest.mark.parametrize("stamp", [STAMPS_END, 2**64 - 1])
def test_a_sample_of_a_clock_that_can_not_be_has_the_time_it_came(world: World, stamp: int) -> None:
    """Or players would wait for centuries."""
    desk, number = begun(world)
    for _ in range(2):
        world.channel.sample(number, text("a"), stamp)
    now = world.channel.now_ns()
    assert [(each.log_time, each.publish_time) for each in desk.paper.written] == [(now, now)] * 2
    assert [each.partition(":")[0] for each in desk.entry.problems] == [HERE]


def test_the_last_time_there_is_is_kept(world: World) -> None:
    """In January 2038."""
    desk, number = begun(world)
    world.channel.sample(number, text("a"), STAMPS_END - 1)
    assert desk.paper.written[0].log_time == STAMPS_END - 1
    assert desk.entry.problems == []


def test_a_latched_sample_of_a_clock_that_can_not_be_comes_now(world: World) -> None:
    """By both of its times."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("subscribe", topic=HERE)
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, latched=True)
    world.define()
    world.channel.sample(number, text("old"), 2**64 - 1)
    desk = Desk(world)
    desk.starts()
    (message,) = desk.paper.written
    assert message.log_time == message.publish_time == world.channel.now_ns()


def test_that_others_pictures_are_recorded_is_told(world: World) -> None:
    """While the robot is at its limit; when there is a place again, what was asked for is recorded."""
    video.robot_comes(world, streams=1)
    viewer = video.Watcher(1)
    stream = viewer.watch(world, link.VideoSettings(width=32, quality=60))
    video.robot_joins(world)
    video.shows(world, stream, 1)
    desk = Desk(world, (), (CAMERA,))
    desk.starts()
    video.shows(world, stream, 2)
    (problem,) = desk.entry.problems
    assert problem.startswith(f"{CAMERA}: the robot is at its limit")
    assert problem.endswith("width 32, quality 60")
    viewer.leave()
    video.robot_joins(world)
    (own,) = world.videos.of(world.robot)
    assert own.settings == link.VideoSettings()
    video.shows(world, own, 1)
    assert len(desk.paper.written) == 2
    assert desk.entry.problems == [problem]


def test_that_pictures_are_reduced_is_told(world: World) -> None:
    """Once for a camera, however often it happens."""
    video.robot_comes(world)
    desk = Desk(world, (), (CAMERA,))
    desk.starts()
    video.robot_joins(world)
    (stream,) = world.videos.of(world.robot)
    stream.message(link.Playing(width=640, height=480, quality=80))
    assert desk.entry.problems == []
    for reduced in (0.5, 0.0, 0.25):
        world.clock.advance(1)
        stream.message(link.Playing(width=32, height=24, quality=40, reduced=reduced))
    (problem,) = desk.entry.problems
    assert problem.startswith(f"{CAMERA}: the robot's uplink is thin")


def test_a_camera_that_is_not_to_be_had_is_asked_for_again(world: World) -> None:
    """As long as the recording runs; why it was not is kept."""
    video.robot_comes(world)
    desk = Desk(world, (), (CAMERA,))
    desk.starts()
    video.robot_joins(world)
    (stream,) = world.videos.of(world.robot)
    stream.shut(Unavailable("the lens is covered"))
    assert desk.entry.problems == [f"{CAMERA}: the lens is covered"]
    world.clock.advance(AGAIN_SECONDS)
    (stream,) = world.videos.of(world.robot)
    stream.shut(Unavailable("the lens is covered"))
    desk.recorder.stop("enough")
    world.clock.advance(AGAIN_SECONDS)
    assert world.videos.of(world.robot) == []
