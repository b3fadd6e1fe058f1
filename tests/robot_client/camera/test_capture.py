"""Cameras without ROS, by a file: what a device or a network gives can't be had in a test."""

from __future__ import annotations

import queue
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot_client.camera.capture import Capture
from robot_client.camera.formats import Pixels

PATIENCE = 20.0


def film(path: Path, pictures: int) -> str:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50, (64, 48))
    for number in range(pictures):
        writer.write(np.full((48, 64, 3), 40 * number, np.uint8))
    writer.release()
    return str(path)


class Seen:
    def __init__(self, source: str) -> None:
        self.pictures: queue.Queue[Pixels] = queue.Queue()
        self.troubles: queue.Queue[str] = queue.Queue()
        self.capture = Capture(source, self.pictures.put, self.troubles.put)

    def grey(self) -> int:
        """Of the next picture, in steps of the film."""
        return round(float(self.pictures.get(timeout=PATIENCE).mean()) / 40)


def test_file_is_shown_over_and_over(tmp_path: Path) -> None:
    """At its end it is opened again, and nobody is told of any trouble."""
    seen = Seen(film(tmp_path / "film.avi", 3))
    with closing(seen.capture):
        assert [seen.grey() for _ in range(7)] == [0, 1, 2, 0, 1, 2, 0]
    assert seen.troubles.empty()


def test_camera_that_comes_later_is_found(tmp_path: Path) -> None:
    """What can't be read is told once and tried again until it can."""
    path = tmp_path / "film.avi"
    seen = Seen(str(path))
    with closing(seen.capture):
        assert str(path) in seen.troubles.get(timeout=PATIENCE)
        film(tmp_path / "other.avi", 1)
        (tmp_path / "other.avi").rename(path)
        assert seen.grey() == 0
    assert seen.troubles.empty()


def test_password_of_a_camera_is_not_told() -> None:
    """Its address is, without what stands before the host."""
    seen = Seen("rtsp://ann:s3c/r@t@127.0.0.1:1/front")
    with closing(seen.capture):
        assert "rtsp://…@127.0.0.1:1/front" in seen.troubles.get(timeout=PATIENCE)


def test_closed_capture_reads_no_more(tmp_path: Path) -> None:
    """Its thread ends."""
    seen = Seen(film(tmp_path / "film.avi", 2))
    seen.grey()
    seen.capture.close()
    with pytest.raises(queue.Empty):
        while True:
            seen.pictures.get(timeout=0.5)  # what comes later than this would come for ever
