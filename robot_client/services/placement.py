"""Where the services ``faces`` and ``markers`` run their functions: here, or on the relay's workers.

Both places give the same results: a worker gets the file that the camera has sent, or the grey image without a loss.
"""

from __future__ import annotations

from typing import Any, NamedTuple, ParamSpec, TypeVar

import cv2

from relay_protocol.errors import Invalid
from robot_client.camera.formats import Pixels
from robot_client.offload.cloud import Cloud, cloud
from robot_client.offload.decisions import Offloaded
from robot_client.offload.device import Device, Where, device
from robot_client.services.camera_model import CameraModel
from robot_client.services.faces import Box, FaceFinder, grey_of
from robot_client.services.markers import Detector, SeenMarker

P = ParamSpec("P")
R = TypeVar("R")

ANSWER_SECONDS = 2.0
"""An image whose result takes longer is processed here."""

PAUSE_SECONDS = 10.0
"""After a call without a result images are processed here for so long, so that a dead link costs no time for each."""


class CameraImage(NamedTuple):
    """An image of a camera.

    :param pixels: BGR or grey
    :param file: the JPEG or PNG that they were decoded from; empty if they came as they are
    """

    pixels: Pixels
    file: bytes = b""


def file_of(image: CameraImage) -> bytes:
    """An image as a file for a worker: its own, or its grey values as PNG."""
    if image.file:
        return image.file
    done, data = cv2.imencode(".png", grey_of(image.pixels), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise Invalid("the image can't be encoded as PNG")
    return bytes(data)


class RunOptions(NamedTuple):
    """Where a service runs its function.

    :param where: ``auto``: as the robot's settings say, and by the state of the device; ``cloud``: on a worker as
        long as one answers
    """

    where: Where = "auto"
    client: Cloud = cloud
    state: Device = device


def face_function(finder: FaceFinder, run: RunOptions) -> Offloaded[[CameraImage], list[Box]]:
    """The function that finds faces in an image, the largest first."""

    def find(image: CameraImage) -> list[Box]:
        return finder.find(grey_of(image.pixels))

    def arguments(image: CameraImage) -> dict[str, Any]:
        return {"image": file_of(image)}

    return _placed(Offloaded(find, "detect_faces", arguments=arguments, result=_boxes, **_options(run)), run)


def marker_function(
    dictionary: str, size: float, run: RunOptions
) -> Offloaded[[CameraImage, CameraModel], list[SeenMarker]]:
    """The function that finds markers in an image, sorted by number.

    :param dictionary: of the markers
    :param size: side of the black square, metres
    """
    detector = Detector(dictionary, size)

    def find(image: CameraImage, model: CameraModel) -> list[SeenMarker]:
        return detector.find(image.pixels, model)

    def arguments(image: CameraImage, model: CameraModel) -> dict[str, Any]:
        *camera, distortion = model
        lens = {"camera": tuple(camera), "distortion": distortion}
        return {"image": file_of(image), "dictionary": dictionary, "size": size, **lens}

    return _placed(
        Offloaded(find, "detect_markers", arguments=arguments, result=_markers, **_options(run)), run
    )


def _options(run: RunOptions) -> dict[str, Any]:
    options: dict[str, Any] = {"repeatable": True, "timeout": ANSWER_SECONDS, "pause": PAUSE_SECONDS}
    if run.where == "cloud":
        # Not forced, so that it runs here without a link.
        options["when"] = lambda _: True
    return options | {"client": run.client, "state": run.state}


def _placed(function: Offloaded[P, R], run: RunOptions) -> Offloaded[P, R]:
    if run.where == "here":
        function.where = "here"
    return function


def _boxes(value: Any) -> list[Box]:
    return [Box(each["left"], each["top"], each["side"]) for each in value]


def _markers(value: Any) -> list[SeenMarker]:
    return [SeenMarker(each["id"], tuple(each["position"]), tuple(each["orientation"])) for each in value]
