"""The daemon's side of its camera process, with processes in memory."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol.link import VideoSettings
from robot_client.camera.ipc import (
    CameraAlive,
    CameraMessage,
    CameraSeen,
    CameraSettings,
    CloseStream,
    DaemonMessage,
    InhibitTopics,
    OpenStream,
    StreamAccepted,
    StreamEnded,
    daemon_decoder,
    encode,
)
from robot_client.camera.supervisor import (
    CHECK_INTERVAL,
    EXIT_SECONDS,
    IDLE_SECONDS,
    RESTART,
    SILENT_SECONDS,
    CameraSupervisor,
)
from tests.worlds.memory_processes import Process, Reactor


def opening(stream: str) -> OpenStream:
    return OpenStream(
        stream=stream, ticket="t", camera="/c", settings=VideoSettings(), topic="/c", heartbeat=2.0
    )


class Scene:
    def __init__(self) -> None:
        self.reactor = Reactor(daemon_decoder.decode)
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

    def reported(self) -> list[DaemonMessage]:
        """Requests to the present process after its settings."""
        return self.process.lines[1:]

    def answer(self, *answers: CameraMessage) -> None:
        self.process.protocol.outReceived(b"".join(map(encode, answers)))

    def live(self, seconds: float) -> None:
        """Lets time pass with a process that reports regularly."""
        for _ in range(round(seconds * 2)):
            self.reactor.advance(0.5)
            self.answer(CameraAlive())


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_no_process_before_the_first_stream(scene: Scene) -> None:
    """The first stream starts it, after its settings; the next one uses the same process."""
    assert scene.reactor.processes == []
    scene.keeper.open(opening("a"))
    scene.keeper.open(opening("b"))
    assert len(scene.reactor.processes) == 1
    assert scene.process.lines[0] == CameraSettings(address="relay:1", node="camera", streams=8)
    assert scene.reported() == [opening("a"), opening("b")]


def test_process_leaves_some_time_after_the_last_stream(scene: Scene) -> None:
    """Its input ends 30 s after the last stream was closed or had ended; no alert is raised."""
    scene.keeper.open(opening("a"))
    scene.keeper.open(opening("b"))
    scene.keeper.close("a", "why")
    assert scene.reported()[-1] == CloseStream(stream="a", reason="why")
    scene.answer(StreamAccepted(stream="b"), StreamEnded(stream="b", reason="lost"))
    scene.live(IDLE_SECONDS - 0.5)
    assert not scene.process.closed
    scene.live(0.5)
    assert scene.process.closed
    scene.process.end()
    assert scene.alerts == []
    assert scene.reactor.getDelayedCalls() == []


def test_renewed_process_is_another_one_without_an_alert(scene: Scene) -> None:
    """Streams that it has not accepted are opened by the next; the relay requests the others again."""
    scene.keeper.renew()
    assert scene.reactor.processes == []
    scene.keeper.open(opening("a"))
    scene.answer(StreamAccepted(stream="a"))
    scene.keeper.open(opening("b"))
    scene.keeper.renew()
    assert scene.process.closed
    scene.process.end()
    assert len(scene.reactor.processes) == 2
    assert scene.reported() == [opening("b")]
    assert scene.alerts == []


def test_stream_in_time_keeps_the_process(scene: Scene) -> None:
    """One that is opened before the 30 s are over uses the same process, which stays."""
    scene.keeper.open(opening("a"))
    scene.keeper.close("a", "why")
    scene.live(IDLE_SECONDS / 2)
    scene.keeper.open(opening("b"))
    scene.live(2 * IDLE_SECONDS)
    assert not scene.process.closed
    assert len(scene.reactor.processes) == 1


def test_end_of_a_stream_is_not_that_of_the_one_opened_again(scene: Scene) -> None:
    """The process reports the old end before it has read the new request; it stays for the new stream."""
    scene.keeper.open(opening("a"))
    scene.answer(StreamAccepted(stream="a"))
    scene.keeper.open(opening("a"))
    scene.answer(StreamEnded(stream="a", reason="lost"), StreamAccepted(stream="a"))
    scene.live(2 * IDLE_SECONDS)
    assert not scene.process.closed


def test_stream_while_the_process_leaves_gets_another(scene: Scene) -> None:
    """It waits until the old one has ended."""
    scene.keeper.open(opening("a"))
    scene.keeper.close("a", "why")
    scene.live(IDLE_SECONDS)
    scene.keeper.open(opening("b"))
    assert len(scene.reactor.processes) == 1
    scene.process.end()
    assert len(scene.reactor.processes) == 2
    assert scene.reported() == [opening("b")]


def test_killed_process_is_started_again(scene: Scene) -> None:
    """0.5 s later, at the next request: the relay requests lost streams again. An alert is raised, and the
    new node has another name.
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
    assert scene.reported() == [opening("a")]


def test_lost_streams_alone_start_nothing(scene: Scene) -> None:
    """Without a request no process is started."""
    scene.keeper.open(opening("a"))
    scene.answer(StreamAccepted(stream="a"))
    scene.process.end()
    scene.reactor.advance(60)
    assert len(scene.reactor.processes) == 1
    scene.keeper.open(opening("b"))
    assert len(scene.reactor.processes) == 2


def test_stream_of_a_dying_process_is_opened_in_the_next(scene: Scene) -> None:
    """Otherwise the relay would wait until its ticket expires."""
    scene.keeper.open(opening("a"))
    scene.answer(StreamAccepted(stream="a"))
    scene.keeper.open(opening("b"))
    scene.process.end()
    scene.reactor.advance(RESTART[0])
    assert scene.reported() == [opening("b")]


def test_stream_whose_ticket_has_ended_is_not_opened(scene: Scene) -> None:
    """A stream that makes each process end is dropped with its ticket."""
    scene.keeper.open(opening("a"))
    for _ in range(60):
        if scene.keeper.pid is not None:
            scene.process.end()
        scene.reactor.advance(1.0)
    scene.keeper.open(opening("b"))
    scene.reactor.advance(RESTART[1])
    assert scene.reported() == [opening("b")]


def test_process_that_can_not_live_is_not_started_all_the_time(scene: Scene) -> None:
    """One that always ends at once is started with growing delays, up to 30 s."""
    for _ in range(300):
        scene.keeper.open(opening("a"))
        if scene.keeper.pid is not None:
            scene.process.end()
        scene.reactor.advance(1.0)
    assert 10 <= len(scene.reactor.processes) <= 18


def test_frozen_process_is_ended(scene: Scene) -> None:
    """It is killed after 20 s without a report; one that reports stays."""
    scene.keeper.open(opening("a"))
    scene.live(3 * SILENT_SECONDS)
    assert scene.process.signals == []
    for _ in range(int(SILENT_SECONDS / CHECK_INTERVAL) + 1):
        scene.reactor.advance(CHECK_INTERVAL)
    assert scene.process.signals == ["KILL"]


def test_process_that_stays_is_ended(scene: Scene) -> None:
    """One that does not end within two seconds is killed."""
    scene.keeper.open(opening("a"))
    scene.keeper.stop()
    assert scene.process.closed
    scene.reactor.advance(EXIT_SECONDS)
    assert scene.process.signals == ["KILL"]


def test_daemon_that_leaves_waits_for_its_process(scene: Scene) -> None:
    """Fires when it has ended; no process is started any more."""
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
    """A daemon that has shown no stream has no process to wait for."""
    left: list[Any] = []
    scene.keeper.stop().addCallback(left.append)
    assert left == [None]


@pytest.mark.parametrize("noise", [b"[INFO] hello\n", b"\xff\xfe\n", b"[]\n\n", b"{" * 99999 + b"\n"])
def test_noise_is_passed_over(scene: Scene, noise: bytes) -> None:
    """Other output in its process hides no report."""
    seen: list[CameraSeen] = []
    scene.keeper.on_seen = seen.append
    scene.keeper.open(opening("a"))
    scene.process.protocol.outReceived(noise)
    reported = CameraSeen(camera="/c", encoding="rgb8", width=4, height=3, fps=2.0, at=7.5)
    scene.answer(reported)
    assert seen == [reported]


def test_silent_topics_are_reported_to_each_process(scene: Scene) -> None:
    """At every change, and to a new process before its streams."""
    scene.keeper.inhibit({"/b", "/a"})
    scene.keeper.open(opening("a"))
    assert scene.reported() == [InhibitTopics(topics=["/a", "/b"]), opening("a")]
    scene.keeper.inhibit([])
    assert scene.reported()[-1] == InhibitTopics(topics=[])


def test_a_process_that_is_missed_is_reported_to_be_there_again_or_not_needed(scene: Scene) -> None:
    """The alert ends."""
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
