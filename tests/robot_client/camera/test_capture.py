"""Cameras without ROS: files, and a network camera on loopback. Tests cannot have a real device."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot_client.camera import capture
from robot_client.camera.capture import Capture
from robot_client.camera.formats import Pixels
from tests.worlds.rtsp_camera import RtspCamera, card, number_of

DRAIN_TIMEOUT = 60.0
LOGIN = "ann:s3cret"


def film(path: Path, pictures: int) -> str:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50, (64, 48))
    for number in range(pictures):
        writer.write(np.full((48, 64, 3), 40 * number, np.uint8))
    writer.release()
    return str(path)


class Seen:
    def __init__(self, source: str, silence: float = DRAIN_TIMEOUT) -> None:
        self.pictures: queue.Queue[Pixels] = queue.Queue()
        self.reported: queue.Queue[tuple[str, str]] = queue.Queue()
        self.capture = Capture(
            source, self.pictures.put, lambda *reported: self.reported.put(reported), silence
        )

    def grey(self) -> int:
        """The grey value of the next frame, in steps of the film."""
        return round(float(self.pictures.get(timeout=DRAIN_TIMEOUT).mean()) / 40)

    def received(self) -> tuple[str, str]:
        """The next report: its level and text."""
        return self.reported.get(timeout=DRAIN_TIMEOUT)


@pytest.fixture(autouse=True)
def all_threads_end() -> Iterator[None]:
    """Threads of closed captures end soon after the camera has gone."""
    yield
    for thread in threading.enumerate():
        if thread.name == "capture":
            thread.join(DRAIN_TIMEOUT)
            assert not thread.is_alive()


@pytest.fixture
def camera() -> Iterator[RtspCamera]:
    with closing(RtspCamera(login=LOGIN)) as made:
        yield made


def plain(path: Path) -> str:
    return str(path)


@pytest.mark.parametrize("source", [plain, Path.as_uri])
def test_file_is_shown_over_and_over(tmp_path: Path, source: Callable[[Path], str]) -> None:
    """At its end it is opened again, without a report; its name may be a URL."""
    path = tmp_path / "a film.avi"
    film(path, 3)
    seen = Seen(source(path))
    with closing(seen.capture):
        assert [seen.grey() for _ in range(7)] == [0, 1, 2, 0, 1, 2, 0]
    assert seen.reported.empty()


def test_camera_that_comes_later_is_found(tmp_path: Path) -> None:
    """An unreadable source is reported once and retried; success is reported too."""
    path = tmp_path / "film.avi"
    seen = Seen(str(path))
    with closing(seen.capture):
        assert seen.received() == ("warn", f"can't be opened: there is no {path}; trying again")
        film(tmp_path / "other.avi", 1)
        (tmp_path / "other.avi").rename(path)
        assert seen.grey() == 0
        assert seen.received() == ("info", "delivers frames again")
    assert seen.reported.empty()


def test_camera_of_the_network_shows_its_frames(camera: RtspCamera) -> None:
    """In order, with its size and colours, with the login in its address; frames from before the stream was
    parsed are dropped.
    """
    seen = Seen(camera.url)
    with closing(seen.capture):
        shown = [seen.pictures.get(timeout=DRAIN_TIMEOUT) for _ in range(12)]
    first = number_of(shown[0])
    assert first > 2
    for number, pixels in enumerate(shown, first):
        assert pixels.shape == card(0).shape
        assert np.abs(pixels.astype(int) - card(number)).mean() < 5
    assert seen.reported.empty()


def test_camera_of_the_network_that_went_away_is_found_again(camera: RtspCamera) -> None:
    """Reported once, by itself, at the same address."""
    seen = Seen(camera.url)
    with closing(seen.capture):
        seen.grey()
        camera.close()
        assert seen.received() == ("warn", "delivers no frames; trying again")
        with closing(RtspCamera(camera.port, LOGIN)):
            assert seen.received() == ("info", "delivers frames again")
            assert seen.reported.empty()


def test_camera_of_the_network_that_falls_silent_is_opened_again(camera: RtspCamera) -> None:
    """Between frames, all of which are shown except an incomplete one; and before the first frame."""
    seen = Seen(camera.url, silence=3)
    with closing(seen.capture):
        last = seen.pictures.get(timeout=DRAIN_TIMEOUT)
        camera.stall()
        assert seen.received() == ("warn", "delivers no frames; trying again")
        while not seen.pictures.empty():
            last = seen.pictures.get()
        assert camera.newest - number_of(last) <= 1
        visits = camera.visits
        camera.goes_on()
        assert seen.received() == ("info", "delivers frames again")
        assert camera.visits > visits
    camera.stall()
    mute = Seen(camera.url, silence=0.5)
    with closing(mute.capture):
        assert mute.received()[1].startswith("can't be reached")


def test_wrong_login_is_reported_without_it(
    camera: RtspCamera, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """No part of the address is shown: neither in the reports, nor in OpenCV's standard error."""
    monkeypatch.setattr(capture, "RETRY", (0.01, 0.01))
    seen = Seen(f"rtsp://bob:hunter2@127.0.0.1:{camera.port}/front?password=hunter3")
    with closing(seen.capture):
        reported = " ".join(seen.received())
        while camera.visits < 3:
            threading.Event().wait(0.05)  # for the next tries, with equal reports
    written = capfd.readouterr()
    assert "password" in reported
    for secret in ("bob", "hunter", str(camera.port)):
        assert secret not in reported
    assert "hunter" not in written.out + written.err


@pytest.mark.parametrize(
    ("device", "why"),
    [
        ("/dev/no-camera", "there is no /dev/no-camera"),
        ("/dev/no-camera?width=640&height=480&format=MJPG", "there is no /dev/no-camera;"),
        ("/dev/null", "delivers no frames"),
    ],
)
def test_device_that_is_missing_or_no_camera_is_reported(device: str, why: str) -> None:
    """By its path, which is not secret."""
    seen = Seen(f"v4l2:{device}")
    with closing(seen.capture):
        level, words = seen.received()
    assert level == "warn"
    assert why in words


def test_device_is_opened_by_its_driver_alone(tmp_path: Path) -> None:
    """Files that other drivers could read are refused as devices."""
    seen = Seen(f"v4l2:{film(tmp_path / 'film.avi', 2)}")
    with closing(seen.capture):
        assert seen.received()[1].startswith("can't be opened")
    assert seen.pictures.empty()


class Device:
    """A device of the kernel, as OpenCV sees it."""

    opened: list[tuple[object, ...]]
    asked: list[tuple[int, float]]

    def __init__(self, *how: object) -> None:
        Device.opened, Device.asked = [how], []

    def isOpened(self) -> bool:
        return True

    def set(self, what: int, value: float) -> bool:
        Device.asked.append((what, value))
        return True

    def grab(self) -> bool:
        return True

    def retrieve(self) -> tuple[bool, Pixels]:
        return True, np.zeros((48, 64, 3), np.uint8)

    def release(self) -> None:
        pass


@pytest.mark.parametrize(
    ("source", "asked"),
    [
        ("v4l2:/dev/video9", []),
        (
            "v4l2:/dev/video9?width=1280&height=720&fps=30&format=MJPG",
            [
                (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG")),
                (cv2.CAP_PROP_FRAME_WIDTH, 1280),
                (cv2.CAP_PROP_FRAME_HEIGHT, 720),
                (cv2.CAP_PROP_FPS, 30),
            ],
        ),
        ("v4l2:/dev/video9?fps=5", [(cv2.CAP_PROP_FPS, 5)]),
    ],
)
def test_device_gets_the_configured_settings(
    monkeypatch: pytest.MonkeyPatch, source: str, asked: list[tuple[int, float]]
) -> None:
    """The format first, which determines sizes and rates; with a buffer of one frame."""
    monkeypatch.setattr(cv2, "VideoCapture", Device)
    seen = Seen(source)
    with closing(seen.capture):
        seen.grey()
        assert Device.opened == [("/dev/video9", cv2.CAP_V4L2)]
        assert Device.asked == [*asked, (cv2.CAP_PROP_BUFFERSIZE, 1)]


def test_closed_capture_reads_no_more(tmp_path: Path) -> None:
    """Its thread ends."""
    seen = Seen(film(tmp_path / "film.avi", 2))
    seen.grey()
    seen.capture.close()
    with pytest.raises(queue.Empty):
        while True:
            seen.pictures.get(timeout=0.5)  # anything later than this would never end
