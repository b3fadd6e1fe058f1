"""Faces, markers and whole frames, by the code of the services ``faces`` and ``markers``."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from relay_protocol.errors import Invalid, SwitchboardError
from relay_protocol.functions import Jpeg, function, progress
from robot_client.camera import formats
from robot_client.camera.formats import Pixels
from robot_client.services.camera_model import CameraModel, of_view
from robot_client.services.faces import Box, FaceFinder, grey_of, track
from robot_client.services.markers import DICTIONARIES, Detector

MAX_FRAMES = 500
"""Most frames of one analysis."""

QUALITY = 85
VIEW_DEGREES = 60.0
"""Assumed horizontal field of view of a camera whose model is not given."""

_GREEN = (0, 255, 0)


class FaceBox(msgspec.Struct, frozen=True):
    """Square of a face, pixels."""

    left: int
    top: int
    side: int


class TrackedFace(FaceBox, frozen=True, kw_only=True):
    """A face that was found again.

    :param similarity: to the earlier one, -1 to 1
    """

    similarity: float


class FoundMarker(msgspec.Struct, frozen=True):
    """A marker in the camera's optical frame; metres, and a quaternion x, y, z, w."""

    id: int
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


class FrameAnalysis(msgspec.Struct, frozen=True, kw_only=True):
    """Everything about one frame.

    :param faces: squares of faces
    :param markers: numbers of markers
    :param keypoints: corners (FAST)
    :param edges: share of the pixels that are edges, 0 to 1
    :param sharpness: variance of the Laplacian
    :param brightness: mean, 0 to 255
    :param motion: mean optical flow since the frame before, pixels
    """

    faces: list[FaceBox]
    markers: list[int]
    keypoints: int
    edges: float
    sharpness: float
    brightness: float
    motion: float


@function(repeatable=True)
def detect_faces(image: Jpeg) -> list[FaceBox]:
    """Find upright frontal faces, the largest first.

    :param image: JPEG or PNG
    """
    return _faces(grey_of(_pixels(image)))


@function(repeatable=True)
def track_face(before: Jpeg, image: Jpeg, face: FaceBox) -> TrackedFace | None:
    """Find a face again near its place in an earlier image; null if nothing there is similar.

    :param before: the earlier image
    :param face: in the earlier image
    """
    found = track(grey_of(_pixels(before)), grey_of(_pixels(image)), Box(face.left, face.top, face.side))
    if found is None:
        return None
    box, similarity = found
    return TrackedFace(box.left, box.top, box.side, similarity=similarity)


@function(repeatable=True)
def detect_markers(
    image: Jpeg,
    dictionary: str = "4X4_50",
    size: Annotated[float, Meta(gt=0)] = 0.1,
    camera: tuple[float, float, float, float] | None = None,
    distortion: tuple[float, ...] = (),
) -> list[FoundMarker]:
    """Find ArUco or AprilTag markers with their poses.

    :param size: side of the black square, metres
    :param camera: fx, fy, cx, cy in pixels; without it a view of 60 degrees is assumed
    :param distortion: OpenCV's coefficients
    """
    if dictionary not in DICTIONARIES:
        raise Invalid(f"'{dictionary}' is no dictionary; there are {', '.join(DICTIONARIES)}")
    pixels = _pixels(image)
    model = of_view(pixels.shape[1], pixels.shape[0], VIEW_DEGREES)
    if camera is not None:
        fx, fy, cx, cy = camera
        model = CameraModel(fx, fy, cx, cy, distortion)
    return [
        FoundMarker(each.number, each.position, each.orientation)
        for each in _detector(dictionary, size).find(pixels, model)
    ]


@function(repeatable=True, seconds=120.0)
def analyse_frames(frames: Annotated[list[Jpeg], Meta(max_length=MAX_FRAMES)]) -> list[FrameAnalysis]:
    """Analyse frames exhaustively: faces, markers, keypoints, edges, sharpness, brightness, motion.

    :param frames: in their order
    """
    found = []
    before: Pixels | None = None
    for number, frame in enumerate(frames):
        grey = grey_of(_pixels(frame))
        found.append(_analyse(grey, before))
        before = grey
        progress((number + 1) / len(frames), f"{number + 1} of {len(frames)} frames")
    return found


@function(repeatable=True)
def annotate_faces(image: Jpeg, quality: Annotated[int, Meta(ge=1, le=100)] = QUALITY) -> Jpeg:
    """The image with squares round its faces.

    :param quality: of the JPEG
    """
    pixels = _pixels(image)
    drawn: Any = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if pixels.ndim == 2 else pixels.copy()
    for each in _faces(grey_of(pixels)):
        cv2.rectangle(drawn, (each.left, each.top), (each.left + each.side, each.top + each.side), _GREEN, 2)
    return encode_jpeg(drawn, quality)


def encode_jpeg(pixels: Pixels, quality: int = QUALITY) -> bytes:
    """An image as JPEG.

    :param pixels: BGR or grey
    """
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise Invalid("the image can't be encoded as JPEG")
    return bytes(data)


@lru_cache(1)
def _finder() -> FaceFinder:
    cv2.setNumThreads(1)
    return FaceFinder()


@lru_cache(1)
def _corners() -> Any:
    vision: Any = cv2
    return vision.FastFeatureDetector_create()


@lru_cache(16)
def _detector(dictionary: str, size: float) -> Detector:
    return Detector(dictionary, size)


def _faces(grey: Pixels) -> list[FaceBox]:
    return [FaceBox(each.left, each.top, each.side) for each in _finder().find(grey)]


def _pixels(file: bytes) -> Pixels:
    try:
        return formats.decode_file(file).pixels
    except SwitchboardError as error:
        raise Invalid(f"the image can't be read: {error}") from None


def _analyse(grey: Pixels, before: Pixels | None) -> FrameAnalysis:
    motion = 0.0
    if before is not None and before.shape == grey.shape:
        start: Any = None
        flow = cv2.calcOpticalFlowFarneback(before, grey, start, 0.5, 3, 15, 3, 5, 1.2, 0)
        motion = float(np.linalg.norm(flow, axis=2).mean())
    model = of_view(grey.shape[1], grey.shape[0], VIEW_DEGREES)
    return FrameAnalysis(
        faces=_faces(grey),
        markers=[each.number for each in _detector("4X4_50", 0.1).find(grey, model)],
        keypoints=len(_corners().detect(grey)),
        edges=float(np.count_nonzero(cv2.Canny(grey, 100, 200)) / grey.size),
        sharpness=float(np.var(cv2.Laplacian(grey, cv2.CV_64F))),
        brightness=float(grey.mean()),
        motion=motion,
    )
