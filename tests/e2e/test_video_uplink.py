"""A robot's uplink for video: each frame is sent once, smaller on a slow uplink, and again after a restart."""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.http_requests import Answer
from tests.worlds.machine_pauses import Pulse
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.video_clients import MjpegViewers, VideoViewer, decoded, get, known, streams
from tests.worlds.waiting import wait_for

TARGET_MS = 300
"""The delay a robot keeps its pictures under."""


class Thin(NamedTuple):
    """A robot with an adjustable uplink."""

    relay: Relay
    robot: Robot
    proxy: ChaosProxy
    token: str


@contextlib.contextmanager
def behind_a_proxy(world: Any, name: str, *sim_options: str) -> Iterator[Thin]:
    """Beside the others, at the same relay."""
    proxy = ChaosProxy(world.relay.robots_port)
    robot = Robot(world.relay, name, port=proxy.port, camera=True, sim_options=sim_options)
    try:
        world.relay.cli("right", "grant", "viewer", name, "viewer")
        yield Thin(world.relay, robot, proxy, world.viewer)
    finally:
        robot.stop()
        proxy.close()
        # It would be visible in all later tests.
        world.relay.cli("robot", "remove", name, "--yes")


@pytest.fixture(scope="module")
def thin(world: Any) -> Iterator[Thin]:
    """A robot with its default camera."""
    with behind_a_proxy(world, "thin") as made:
        yield made


@pytest.fixture
def sharp(world: Any) -> Iterator[Thin]:
    """A robot with large and frequent frames."""
    with behind_a_proxy(world, "sharp", "--camera-size", "1280x720", "--camera-fps", "30") as made:
        yield made


def test_ten_viewers_are_one_stream_which_ends_with_the_last(thin: Thin) -> None:
    """The robot sends it once for all, and nothing 2 s after the last viewer."""
    known(thin.relay, thin.token, "thin")
    with (
        MjpegViewers(thin.relay, thin.token, 9, "thin") as crowd,
        VideoViewer(thin.relay, thin.token, "thin") as socket,
    ):
        socket.picture()
        wait_for("each has a picture", lambda: all(each.seen for each in crowd.viewers))
        (stream,) = streams(thin.relay, thin.token, "thin")
        assert stream["viewers"] == 10
        before, seen = thin.proxy.up, crowd.viewers[0].seen
        pictures = socket.watch(2)
        sizes = statistics.median(len(each.body) for each in pictures)
        # In sequence on one link: not more bytes than one stream has.
        assert thin.proxy.up - before < 1.5 * sizes * (crowd.viewers[0].seen - seen + 2)
    left = time.monotonic()
    wait_for("the stream is closed", lambda: not streams(thin.relay, thin.token, "thin"))
    time.sleep(max(0.0, left + 2 - time.monotonic()))  # the stream may continue this long
    before = thin.proxy.up
    time.sleep(1)  # shows absence
    assert thin.proxy.up - before < sizes / 2


@pytest.mark.parametrize("kilobits", [1000, 200])
def test_a_thin_uplink_makes_frames_smaller_not_late(thin: Thin, kilobits: int) -> None:
    """After 5 s the delay is below the target; when the uplink recovers, so do the frames."""
    known(thin.relay, thin.token, "thin")
    with VideoViewer(thin.relay, thin.token, "thin") as socket:
        whole = socket.watch_until("pictures are as asked for", lambda _: socket.playing["reduced"] == 0, 30)
        thin.proxy.squeeze(kilobits * 1000)
        try:
            with Pulse() as pulse:
                socket.watch(5)
                pictures = socket.watch(4)
                late_ms = TARGET_MS + 1000 * pulse.held_up()
            playing = socket.playing
        finally:
            thin.proxy.squeeze(None)
        delays = sorted(each.delay_ms for each in pictures)
        assert statistics.median(delays) < late_ms, (delays, playing)
        assert playing["delay_ms"] < late_ms, (delays, playing)
        assert playing["reduced"] > 0
        assert statistics.median(len(each.body) for each in pictures) < len(whole.body) / 2
        socket.watch_until("pictures are as before", lambda _: socket.playing["reduced"] == 0, 60)
        after = socket.picture()
        assert decoded(after.body).shape == (480, 640, 3)


def test_large_frames_under_way_do_not_hold_up_the_small_ones(sharp: Thin) -> None:
    """At 200 kbit/s frames that would take seconds are abandoned; 5 s later the delay is below the target."""
    known(sharp.relay, sharp.token, "sharp")
    with VideoViewer(sharp.relay, sharp.token, "sharp", quality=100) as socket:
        socket.watch_until("pictures are large", lambda each: len(each.body) > 150_000, 30)
        socket.watch(3)
        sharp.proxy.squeeze(200_000)
        with Pulse() as pulse:
            socket.watch(5)
            pictures = socket.watch(4)
            late_ms = TARGET_MS + 1000 * pulse.held_up()
        delays = sorted(each.delay_ms for each in pictures)
        assert statistics.median(delays) < late_ms, (delays, socket.playing)
        assert max(len(each.body) for each in pictures) < 20_000
        assert socket.playing["reduced"] > 0
        sharp.proxy.squeeze(None)
        socket.watch_until("pictures are large again", lambda each: each.head["width"] == 1280, 60)


def test_a_png_comes_over_a_thin_uplink_however_long_it_takes(thin: Thin) -> None:
    """Longer than the timeout for a first frame: it is never abandoned."""

    def png() -> Answer | None:
        # On a busy machine the camera process may start too late for the first viewer.
        answer = get(thin.relay, thin.token, "snapshot", "thin", type="png")
        return answer if answer.status == 200 else None

    known(thin.relay, thin.token, "thin")
    whole = wait_for("a PNG comes", png)
    wait_for("the stream is closed", lambda: not streams(thin.relay, thin.token, "thin"))
    thin.proxy.squeeze(8 * len(whole.body) / 14)
    try:
        thinly = wait_for("a PNG comes", png)
    finally:
        thin.proxy.squeeze(None)
    assert thinly.headers["Content-Type"] == "image/png"
    assert decoded(thinly.body).shape == (480, 640, 3)


def test_frames_go_on_when_the_daemon_is_started_again(thin: Thin) -> None:
    """On the same websocket, by themselves."""
    known(thin.relay, thin.token, "thin")
    with VideoViewer(thin.relay, thin.token, "thin") as socket:
        before = socket.picture()
        thin.robot.daemon.kill()
        thin.robot.start_daemon()
        again = socket.watch_until(
            "a picture taken after that", lambda each: each.head["stamp"] > before.head["stamp"] + 1, 30
        )
        assert decoded(again.body).shape == (480, 640, 3)
        for _ in range(4):
            socket.picture()
