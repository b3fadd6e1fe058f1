"""Cameras without ROS: files, and a camera of the network on loopback. No device can be had in a test."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from switchboard_rtsp import RtspCamera, card, number_of

from robot_client.camera import capture
from robot_client.camera.capture import Capture
from robot_client.camera.formats import Pixels

PATIENCE = 60.0
LOGIN = "ann:s3cret"


def film(path: Path, pictures: int) -> str:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50, (64, 48))
    for number in range(pictures):
        writer.write(np.full((48, 64, 3), 40 * number, np.uint8))
    writer.release()
    return str(path)


class Seen:
    def __init__(self, source: str, silence: float = PATIENCE) -> None:
        self.pictures: queue.Queue[Pixels] = queue.Queue()
        self.told: queue.Queue[tuple[str, str]] = queue.Queue()
        self.capture = Capture(source, self.pictures.put, lambda *told: self.told.put(told), silence)

    def grey(self) -> int:
        """Of the next picture, in steps of the film."""
        return round(float(self.pictures.get(timeout=PATIENCE).mean()) / 40)

    def hears(self) -> tuple[str, str]:
        """The next that is told: its level, and the words."""
        return self.told.get(timeout=PATIENCE)


@pytest.fixture(autouse=True)
def all_threads_end() -> Iterator[None]:
    """Those of captures that were closed, soon after the camera is gone."""
    yield
    for thread in threading.enumerate():
        if thread.name == "capture":
            thread.join(PATIENCE)
            assert not thread.is_alive()


@pytest.fixture
def camera() -> Iterator[RtspCamera]:
    with closing(RtspCamera(login=LOGIN)) as made:
        yield made


def plain(path: Path) -> str:
    return str(path)


@pytest.mark.parametrize("source", [plain, Path.as_uri])
def test_file_is_shown_over_and_over(tmp_path: Path, source: Callable[[Path], str]) -> None:
    """At its end it is opened again, and nobody is told of any trouble; its name may be an address."""
    path = tmp_path / "a film.avi"
    film(path, 3)
    seen = Seen(source(path))
    with closing(seen.capture):
        assert [seen.grey() for _ in range(7)] == [0, 1, 2, 0, 1, 2, 0]
    assert seen.told.empty()


def test_camera_that_comes_later_is_found(tmp_path: Path) -> None:
    """What can't be read is told once and tried again until it can, which is told too."""
    path = tmp_path / "film.avi"
    seen = Seen(str(path))
    with closing(seen.capture):
        assert seen.hears() == ("warn", f"can't be opened: there is no {path}; it is tried again")
        film(tmp_path / "other.avi", 1)
        (tmp_path / "other.avi").rename(path)
        assert seen.grey() == 0
        assert seen.hears() == ("info", "gives pictures again")
    assert seen.told.empty()


def test_camera_of_the_network_shows_its_pictures(camera: RtspCamera) -> None:
    """One after the other, in its size and colours, with the login in its address; not those that were there before it
    was known what they are.
    """
    seen = Seen(camera.url)
    with closing(seen.capture):
        shown = [seen.pictures.get(timeout=PATIENCE) for _ in range(12)]
    first = number_of(shown[0])
    assert first > 2
    for number, pixels in enumerate(shown, first):
        assert pixels.shape == card(0).shape
        assert np.abs(pixels.astype(int) - card(number)).mean() < 5
    assert seen.told.empty()


def test_camera_of_the_network_that_went_away_is_found_again(camera: RtspCamera) -> None:
    """Told once, by itself, on the same address."""
    seen = Seen(camera.url)
    with closing(seen.capture):
        seen.grey()
        camera.close()
        assert seen.hears() == ("warn", "gives no pictures; it is tried again")
        with closing(RtspCamera(camera.port, LOGIN)):
            assert seen.hears() == ("info", "gives pictures again")
            assert seen.told.empty()


def test_camera_of_the_network_that_falls_silent_is_opened_again(camera: RtspCamera) -> None:
    """In the middle of its pictures, of which none is kept back but one that may not be whole; and before the first."""
    seen = Seen(camera.url, silence=3)
    with closing(seen.capture):
        last = seen.pictures.get(timeout=PATIENCE)
        camera.stall()
        assert seen.hears() == ("warn", "gives no pictures; it is tried again")
        while not seen.pictures.empty():
            last = seen.pictures.get()
        assert camera.newest - number_of(last) <= 1
        visits = camera.visits
        camera.goes_on()
        assert seen.hears() == ("info", "gives pictures again")
        assert camera.visits > visits
    camera.stall()
    mute = Seen(camera.url, silence=0.5)
    with closing(mute.capture):
        assert mute.hears()[1].startswith("can't be reached")


def test_wrong_login_is_told_without_it(
    camera: RtspCamera, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Nothing of the address is: neither by the words, nor by what OpenCV writes to standard error."""
    monkeypatch.setattr(capture, "RETRY", (0.01, 0.01))
    seen = Seen(f"rtsp://bob:hunter2@127.0.0.1:{camera.port}/front?password=hunter3")
    with closing(seen.capture):
        told = " ".join(seen.hears())
        while camera.visits < 3:
            threading.Event().wait(0.05)  # for the next tries, whose words would be the same
    written = capfd.readouterr()
    assert "password" in told
    for secret in ("bob", "hunter", str(camera.port)):
        assert secret not in told
    assert "hunter" not in written.out + written.err


@pytest.mark.parametrize(
    ("device", "why"),
    [
        ("/dev/no-camera", "there is no /dev/no-camera"),
        ("/dev/no-camera?width=640&height=480&format=MJPG", "there is no /dev/no-camera;"),
        ("/dev/null", "gives no pictures"),
    ],
)
def test_device_that_is_missing_or_no_camera_is_told(device: str, why: str) -> None:
    """By its path, which is no secret."""
    seen = Seen(f"v4l2:{device}")
    with closing(seen.capture):
        level, words = seen.hears()
    assert level == "warn"
    assert why in words


def test_device_is_opened_by_its_driver_alone(tmp_path: Path) -> None:
    """What others could read is refused where a device is asked for."""
    seen = Seen(f"v4l2:{film(tmp_path / 'film.avi', 2)}")
    with closing(seen.capture):
        assert seen.hears()[1].startswith("can't be opened")
    assert seen.pictures.empty()


class Device:
    """A device of the kernel, as OpenCV has it."""

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
def test_device_is_asked_for_what_is_wanted_of_it(
    monkeypatch: pytest.MonkeyPatch, source: str, asked: list[tuple[int, float]]
) -> None:
    """The format first, on which sizes and rates depend; and for no more pictures than one in advance."""
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
            seen.pictures.get(timeout=0.5)  # what comes later than this would come for ever
