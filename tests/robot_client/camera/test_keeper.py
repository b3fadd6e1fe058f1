"""The daemon's side of its camera process, with processes in memory."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol.link import VideoSettings
from robot_client.camera.ipc import (
    Answer,
    CameraAlive,
    CameraSeen,
    CameraSettings,
    CloseStream,
    Line,
    NoFrames,
    OpenStream,
    StreamAccepted,
    StreamEnded,
    decoder,
    encode,
)
from robot_client.camera.supervisor import IDLE, LEAVE, LOOK_EVERY, RESTART, SILENT, CameraSupervisor
from tests.robot_client.processes import Process, Reactor


def opening(stream: str) -> OpenStream:
    return OpenStream(
        stream=stream, ticket="t", camera="/c", settings=VideoSettings(), topic="/c", heartbeat=2.0
    )


class Scene:
    def __init__(self) -> None:
        self.reactor = Reactor(decoder.decode)
        self.alerts: list[str] = []
        self.keeper = CameraSupervisor(
            self.reactor, CameraSettings(address="relay:1", node="camera", streams=8)
        )
        self.keeper.on_alert = self._told

    def _told(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        self.alerts.append(f"{kind} {about} {'over' if over else level}")

    @property
    def process(self) -> Process:
        return self.reactor.processes[-1]

    def told(self) -> list[Line]:
        """What the process that lives now was told after its settings."""
        return self.process.lines[1:]

    def answer(self, *answers: Answer) -> None:
        self.process.protocol.outReceived(b"".join(map(encode, answers)))

    def live(self, seconds: float) -> None:
        """Let time pass for a process that says now and then that it lives."""
        for _ in range(round(seconds * 2)):
            self.reactor.advance(0.5)
            self.answer(CameraAlive())


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_no_process_before_anybody_wants_a_picture(scene: Scene) -> None:
    """It is started by the first stream, and told its settings before it; the next goes to the same one."""
    assert scene.reactor.processes == []
    scene.keeper.open(opening("a"))
    scene.keeper.open(opening("b"))
    assert len(scene.reactor.processes) == 1
    assert scene.process.lines[0] == CameraSettings(address="relay:1", node="camera", streams=8)
    assert scene.told() == [opening("a"), opening("b")]


def test_process_leaves_some_time_after_the_last_stream(scene: Scene) -> None:
    """30 s without a stream, closed by the relay or ended by itself, and its input ends; nobody is alarmed."""
    scene.keeper.open(opening("a"))
    scene.keeper.open(opening("b"))
    scene.keeper.close("a", "why")
    assert scene.told()[-1] == CloseStream(stream="a", why="why")
    scene.answer(StreamAccepted(stream="b"), StreamEnded(stream="b", why="lost"))
    scene.live(IDLE - 0.5)
    assert not scene.process.closed
    scene.live(0.5)
    assert scene.process.closed
    scene.process.end()
    assert scene.alerts == []
    assert scene.reactor.getDelayedCalls() == []


def test_stream_in_time_keeps_the_process(scene: Scene) -> None:
    """One that is opened before the 30 s are over is shown by the same process, which stays."""
    scene.keeper.open(opening("a"))
    scene.keeper.close("a", "why")
    scene.live(IDLE / 2)
    scene.keeper.open(opening("b"))
    scene.live(2 * IDLE)
    assert not scene.process.closed
    assert len(scene.reactor.processes) == 1


def test_end_of_a_stream_is_not_that_of_the_one_opened_anew(scene: Scene) -> None:
    """The process has not read of the new one when it tells that the old one has ended; it stays for the new one."""
    scene.keeper.open(opening("a"))
    scene.answer(StreamAccepted(stream="a"))
    scene.keeper.open(opening("a"))
    scene.answer(StreamEnded(stream="a", why="lost"), StreamAccepted(stream="a"))
    scene.live(2 * IDLE)
    assert not scene.process.closed


def test_stream_while_the_process_leaves_gets_another(scene: Scene) -> None:
    """It waits until the old one is gone."""
    scene.keeper.open(opening("a"))
    scene.keeper.close("a", "why")
    scene.live(IDLE)
    scene.keeper.open(opening("b"))
    assert len(scene.reactor.processes) == 1
    scene.process.end()
    assert len(scene.reactor.processes) == 2
    assert scene.told() == [opening("b")]


def test_killed_process_is_started_again(scene: Scene) -> None:
    """Half a second later, when a stream is wanted: the relay asks anew for those that were lost. A person is told, and
    the new node has another name.
    """
    scene.keeper.open(opening("a"))
    scene.answer(StreamAccepted(stream="a"))
    scene.process.end()
    assert scene.alerts == ["module camera error"]
    scene.keeper.open(opening("a"))
    assert len(scene.reactor.processes) == 1
    scene.reactor.advance(RESTART[0])
    assert len(scene.reactor.processes) == 2
    assert scene.process.lines[0].node == "camera_1"
    assert scene.told() == [opening("a")]


def test_lost_streams_alone_start_nothing(scene: Scene) -> None:
    """Without anybody who asks again, no process is started."""
    scene.keeper.open(opening("a"))
    scene.answer(StreamAccepted(stream="a"))
    scene.process.end()
    scene.reactor.advance(60)
    assert len(scene.reactor.processes) == 1
    scene.keeper.open(opening("b"))
    assert len(scene.reactor.processes) == 2


def test_stream_told_to_a_dying_process_is_told_to_the_next(scene: Scene) -> None:
    """The relay would wait for it until its ticket ends."""
    scene.keeper.open(opening("a"))
    scene.answer(StreamAccepted(stream="a"))
    scene.keeper.open(opening("b"))
    scene.process.end()
    scene.reactor.advance(RESTART[0])
    assert scene.told() == [opening("b")]


def test_stream_whose_ticket_has_ended_is_told_no_more(scene: Scene) -> None:
    """One that ends each process that is told of it is forgotten with its ticket."""
    scene.keeper.open(opening("a"))
    for _ in range(60):
        if scene.keeper.pid is not None:
            scene.process.end()
        scene.reactor.advance(1.0)
    scene.keeper.open(opening("b"))
    scene.reactor.advance(RESTART[1])
    assert scene.told() == [opening("b")]


def test_process_that_can_not_live_is_not_started_all_the_time(scene: Scene) -> None:
    """One that dies at once each time is started ever more seldom, but at least every 30 s."""
    for _ in range(300):
        scene.keeper.open(opening("a"))
        if scene.keeper.pid is not None:
            scene.process.end()
        scene.reactor.advance(1.0)
    assert 10 <= len(scene.reactor.processes) <= 18


def test_frozen_process_is_ended(scene: Scene) -> None:
    """20 s without a word and it is killed; one that speaks is left alone."""
    scene.keeper.open(opening("a"))
    scene.live(3 * SILENT)
    assert scene.process.signals == []
    for _ in range(int(SILENT / LOOK_EVERY) + 1):
        scene.reactor.advance(LOOK_EVERY)
    assert scene.process.signals == ["KILL"]


def test_process_that_stays_is_ended(scene: Scene) -> None:
    """One that does not leave within two seconds is killed."""
    scene.keeper.open(opening("a"))
    scene.keeper.stop()
    assert scene.process.closed
    scene.reactor.advance(LEAVE)
    assert scene.process.signals == ["KILL"]


def test_daemon_that_leaves_waits_for_its_process(scene: Scene) -> None:
    """Fires when it is gone; nothing is started any more."""
    left: list[Any] = []
    scene.keeper.open(opening("a"))
    scene.keeper.stop().addCallback(left.append)
    assert left == []
    scene.process.end()
    assert left == [None]
    assert scene.alerts == []
    scene.keeper.open(opening("b"))
    assert len(scene.reactor.processes) == 1
    assert scene.reactor.getDelayedCalls() == []


def test_without_a_process_leaving_is_done_at_once(scene: Scene) -> None:
    """A daemon that never showed anything has nothing to wait for."""
    left: list[Any] = []
    scene.keeper.stop().addCallback(left.append)
    assert left == [None]


@pytest.mark.parametrize("noise", [b"[INFO] hello\n", b"\xff\xfe\n", b"[]\n\n", b"{" * 99999 + b"\n"])
def test_noise_is_passed_over(scene: Scene, noise: bytes) -> None:
    """What something in its process writes to its output hides none of its answers."""
    seen: list[CameraSeen] = []
    scene.keeper.on_seen = seen.append
    scene.keeper.open(opening("a"))
    scene.process.protocol.outReceived(noise)
    told = CameraSeen(camera="/c", encoding="rgb8", width=4, height=3, fps=2.0, at=7.5)
    scene.answer(told)
    assert seen == [told]


def test_silent_topics_are_told_to_each_process(scene: Scene) -> None:
    """Whenever they change, and to a process that starts, before its streams."""
    scene.keeper.silence({"/b", "/a"})
    scene.keeper.open(opening("a"))
    assert scene.told() == [NoFrames(topics=["/a", "/b"]), opening("a")]
    scene.keeper.silence([])
    assert scene.told()[-1] == NoFrames(topics=[])


def test_a_process_that_is_missed_is_told_to_be_there_again_or_not_needed(scene: Scene) -> None:
    """Nobody goes on worrying."""
    scene.keeper.open(opening("a"))
    scene.answer(StreamAccepted(stream="a"))
    scene.process.end()
    scene.keeper.open(opening("a"))
    scene.reactor.advance(RESTART[0])
    scene.answer(CameraAlive())
    scene.answer(CameraAlive())
    assert scene.alerts == ["module camera error", "module camera over"]
    scene.process.end()
    scene.reactor.advance(RESTART[1])
    assert scene.alerts[2:] == ["module camera error", "module camera over"]
