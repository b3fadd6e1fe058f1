"""The services' functions, here and there: the same results, and here without a link."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from relay_protocol.errors import SwitchboardError, Unavailable
from relay_protocol.functions import CallFailed, decode_value, encode_value
from robot_client.camera import formats
from robot_client.camera.formats import Pixels
from robot_client.functions.vision import detect_faces, detect_markers, encode_jpeg
from robot_client.offload.cloud import Cloud
from robot_client.offload.device import Device, DeviceState, Where, publish
from robot_client.services.faces import Box, FaceFinder
from robot_client.services.placement import (
    PAUSE_SECONDS,
    CameraImage,
    RunOptions,
    face_function,
    marker_function,
)
from tests.robot_client.services.test_markers import LENS, SIZE, drawn
from tests.worlds.face_images import EILEEN, scene


class DirectCloud(Cloud):
    """Runs the functions that workers have, on values as they are sent.

    :ivar error: raised in place of a result
    """

    def __init__(self) -> None:
        super().__init__()
        self.error: SwitchboardError | None = None
        self.calls: list[str] = []
        self.sizes: list[int] = []

    def call(self, function: str, /, **given: Any) -> Any:
        self.calls.append(function)
        if self.error is not None:
            raise self.error
        del given["timeout"], given["newest"], given["version"]
        sent = encode_value(given)
        self.sizes.append(len(sent))
        work: Any = {"detect_faces": detect_faces, "detect_markers": detect_markers}[function]
        return decode_value(encode_value(work(**decode_value(sent))))


class Placed:
    """A device with a published state, and a service on it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cloud = DirectCloud()

    def run(self, where: Where = "auto") -> RunOptions:
        return RunOptions(where, self.cloud, Device(self.folder))

    def publish(self, where: Where = "auto", **critical: bool) -> None:
        publish(self.folder, DeviceState(time.time(), critical, where=where))


@pytest.fixture
def placed(tmp_path: Path) -> Placed:
    return Placed(tmp_path)


@pytest.fixture(scope="module")
def finder() -> FaceFinder:
    return FaceFinder()


def noisy(pixels: Pixels) -> Pixels:
    """As a colour camera would see it."""
    colours: Any = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if pixels.ndim == 2 else pixels
    noise = np.random.default_rng(1).normal(0, 6, colours.shape)
    return np.clip(colours + noise, 0, 255).astype(np.uint8)


def forms(pixels: Pixels) -> list[CameraImage]:
    """An image as cameras send it: raw grey, raw colours, and JPEG."""
    coloured = noisy(pixels)
    file = encode_jpeg(coloured)
    grey = np.asarray(cv2.cvtColor(coloured, cv2.COLOR_BGR2GRAY), np.uint8)
    return [CameraImage(grey), CameraImage(coloured), CameraImage(formats.decode_file(file).pixels, file)]


def test_faces_are_the_same_here_and_there(placed: Placed, finder: FaceFinder) -> None:
    here, there = (face_function(finder, placed.run(where)) for where in ("here", "cloud"))
    for picture in forms(scene(EILEEN, 0.8, (50, 20))):
        found = here(picture)
        assert len(found) == 1 and all(isinstance(each, Box) for each in found)
        assert there(picture) == found
    assert placed.cloud.calls == ["detect_faces"] * 3


@pytest.mark.parametrize("distortion", [(), (0.1, -0.05, 0.001, 0.002, 0.01)])
def test_markers_are_the_same_here_and_there(placed: Placed, distortion: tuple[float, ...]) -> None:
    here, there = (marker_function("4X4_50", SIZE, placed.run(where)) for where in ("here", "cloud"))
    model = LENS._replace(distortion=distortion)
    for picture in forms(drawn(7, (0.2, 0.1, 1.5), 0.4)):
        found = here(picture, model)
        assert [each.number for each in found] == [7]
        assert there(picture, model) == found


@pytest.mark.parametrize(
    ("where", "settings", "critical", "away", "why"),
    [
        ("auto", "auto", {}, False, "nothing is critical"),
        ("auto", "auto", {"cpu": True}, True, "cpu critical"),
        ("auto", "auto", {"cpu": True, "signal": True}, False, "the signal is too weak"),
        ("auto", "cloud", {}, True, "as the robot's settings say"),
        ("auto", "here", {"cpu": True}, False, "as the robot's settings say"),
        ("cloud", "here", {}, True, "as 'when' says"),
        ("here", "cloud", {"cpu": True}, False, "forced"),
    ],
)
def test_settings_and_state_of_the_device_decide(
    placed: Placed, where: Where, settings: Where, critical: dict[str, bool], away: bool, why: str
) -> None:
    find = marker_function("4X4_50", SIZE, placed.run(where))
    placed.publish(settings, **critical)
    find(CameraImage(drawn(7, (0.2, 0.1, 1.5))), LENS)
    assert bool(placed.cloud.calls) is away
    assert find.ran_away is away
    assert find.shown() == {"runs": "cloud" if away else "here", "because": why}


@pytest.mark.parametrize(
    "error",
    [
        Unavailable("the relay can't be reached"),
        CallFailed("lost", "the link was lost"),
        CallFailed("timeout", "no answer in time"),
        CallFailed("too_large", "the arguments are too large"),
    ],
)
def test_without_a_result_it_runs_here_for_a_while(
    placed: Placed, error: SwitchboardError, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, later = time.monotonic, 0.0
    monkeypatch.setattr(time, "monotonic", lambda: real() + later)
    find = marker_function("4X4_50", SIZE, placed.run("cloud"))
    placed.cloud.error = error
    picture = CameraImage(drawn(7, (0.2, 0.1, 1.5)))
    for _ in range(3):
        assert [each.number for each in find(picture, LENS)] == [7]
    assert len(placed.cloud.calls) == 1
    assert not find.ran_away
    placed.cloud.error = None
    later = PAUSE_SECONDS
    find(picture, LENS)
    assert find.ran_away


def test_a_compressed_image_is_sent_as_it_came(placed: Placed) -> None:
    file = encode_jpeg(noisy(drawn(7, (0.2, 0.1, 1.5))))
    marker_function("4X4_50", SIZE, placed.run("cloud"))(
        CameraImage(formats.decode_file(file).pixels, file), LENS
    )
    assert len(file) < placed.cloud.sizes[0] < len(file) + 500
