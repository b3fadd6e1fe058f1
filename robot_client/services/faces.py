"""Finds and recognises faces in images.

Faces are found by a cascade of multi-block local binary patterns (L. Zhang et al., "Face Detection Based on Multi-Block
LBP Representation", 2007), OpenCV's, trained on frontal faces; scikit-image has it in its wheel. They are recognised by
histograms of local binary patterns (T. Ahonen et al., "Face Recognition with Local Binary Patterns", 2004).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from skimage.data import lbp_frontal_face_cascade_filename
from skimage.feature import Cascade, local_binary_pattern

from relay_protocol.errors import Invalid, SwitchboardError, Unavailable
from relay_protocol.text import is_printable
from robot_client.camera import formats
from robot_client.camera.formats import Pixels
from robot_client.services.camera_model import CameraModel, bearing_of, distance_of

FACE = 0.17
"""Assumed side of the detected square, metres: the width of an adult's face."""

SEARCH_WIDTH = 400
"""Wider images are scaled to this width, pixels."""
MIN_FACE = 24
"""Side of the smallest face, pixels of the scaled image; the size the cascade was trained with."""
SCALE_FACTOR = 1.2
"""Ratio of successive face sizes in the search."""
STEP = 1.3
"""Step of the search, pixels at the smallest size."""

MIN_SIMILARITY = 0.7
"""Least similarity, 0 to 1, by which a face is recognised."""

MAX_IMAGES = 500
"""Most images of persons."""
MAX_FILE_BYTES = 20_000_000
"""Largest image file, bytes."""
LONGEST_NAME = 64
_KINDS = (".jpg", ".jpeg", ".png")

_SIDE, _CELLS, _POINTS, _RADIUS = 112, 7, 8, 2
"""Pixels of a scaled face; cells in a row; points of a pattern and their radius, pixels."""
_PATTERNS = 59
"""Of 8 points the 58 that are uniform, and the others."""
_SHIFTS = (-0.06, 0.0, 0.06)
"""Offsets, as fractions of a face, for which each known face is stored too."""

Grey = npt.NDArray[np.uint8]
Histograms = npt.NDArray[np.float32]


class Box(NamedTuple):
    """Square of a face, pixels."""

    left: int
    top: int
    side: int


class SeenFace(NamedTuple):
    """A face in the camera's optical frame: x to the right, y down, z ahead (REP 103).

    :ivar box: in the image
    :ivar name: of the person; ``None`` when not recognised
    :ivar similarity: to the most similar known face, 0 to 1; 0 without known faces
    :ivar position: metres, assuming a face of the size :data:`FACE`
    """

    box: Box
    name: str | None
    similarity: float
    position: tuple[float, float, float]

    @property
    def distance(self) -> float:
        """Metres from the camera."""
        return distance_of(self.position)

    @property
    def bearing(self) -> float:
        """Radians from straight ahead, positive to the left."""
        return bearing_of(self.position)


class FaceFinder:
    """Finds upright frontal faces."""

    def __init__(self) -> None:
        self._cascade: Any = Cascade(lbp_frontal_face_cascade_filename())

    def find(self, grey: Grey) -> list[Box]:
        """The faces in an image, the largest first.

        :param grey: shape (height, width)
        """
        height, width = grey.shape
        factor = min(1.0, SEARCH_WIDTH / width)
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        small = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA)) if factor < 1.0 else grey
        largest = min(small.shape)
        if largest <= MIN_FACE:
            return []
        found = self._cascade.detect_multi_scale(
            small.astype(np.float32) / 255,
            scale_factor=SCALE_FACTOR,
            step_ratio=STEP,
            min_size=(MIN_FACE, MIN_FACE),
            max_size=(largest, largest),
        )
        boxes = [
            Box(round(each["c"] / factor), round(each["r"] / factor), round(each["width"] / factor))
            for each in found
        ]
        return _without_overlaps(sorted(boxes, key=lambda box: -box.side))


def _without_overlaps(boxes: list[Box]) -> list[Box]:
    """Remove squares whose centre is in a larger one: they are the same face."""
    found: list[Box] = []
    for box in boxes:
        x, y = box.left + box.side / 2, box.top + box.side / 2
        if not any(0 < x - each.left < each.side and 0 < y - each.top < each.side for each in found):
            found.append(box)
    return found


TRACK_REACH = 0.75
"""How far a face is searched from its earlier place, in its own sides."""

TRACK_SIDE = 48
"""Faces are scaled to this side for tracking, pixels."""

MIN_TRACKED = 0.5
"""Least similarity of a face that is found again, -1 to 1."""


def track(before: Grey, grey: Grey, box: Box) -> tuple[Box, float] | None:
    """Find a face again near its earlier place, by normalised cross-correlation.

    :param before: the earlier image
    :param box: of the face in it
    :returns: its square and the similarity, -1 to 1; ``None`` if nothing there is similar
    """
    height, width = grey.shape
    reach = round(box.side * TRACK_REACH)
    left, top = max(0, box.left - reach), max(0, box.top - reach)
    area = grey[top : min(height, box.top + box.side + reach), left : min(width, box.left + box.side + reach)]
    face = before[max(0, box.top) : box.top + box.side, max(0, box.left) : box.left + box.side]
    factor = min(1.0, TRACK_SIDE / box.side)
    small = [
        cv2.resize(each, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) for each in (area, face)
    ]
    if min(face.shape) < 2 or any(a < f for a, f in zip(small[0].shape, small[1].shape, strict=True)):
        return None
    score = cv2.matchTemplate(small[0], small[1], cv2.TM_CCOEFF_NORMED)
    _, best, _, (x, y) = cv2.minMaxLoc(score)
    if not best >= MIN_TRACKED:
        return None
    return Box(left + round(x / factor), top + round(y / factor), box.side), float(best)


class KnownFaces:
    """Known persons and their faces.

    :param similarity: least similarity of a recognised face, 0 to 1
    """

    def __init__(self, similarity: float = MIN_SIMILARITY) -> None:
        self._min_similarity = similarity
        self._names: list[str] = []
        self._known: list[Histograms] = []
        self._all: Histograms | None = None

    @property
    def names(self) -> list[str]:
        """Names, sorted."""
        return sorted(set(self._names))

    def add(self, name: str, grey: Grey, box: Box) -> None:
        """Add a face of a person.

        :param grey: the image with the face
        """
        for down in _SHIFTS:
            for right in _SHIFTS:
                at = Box(box.left + round(right * box.side), box.top + round(down * box.side), box.side)
                self._names.append(name)
                self._known.append(histograms(grey, at))
        self._all = None

    def recognise(self, grey: Grey, box: Box) -> tuple[str | None, float]:
        """Name of the person, or ``None``, and the similarity.

        :param grey: the image with the face
        """
        if not self._known:
            return None, 0.0
        if self._all is None:
            self._all = np.stack(self._known)
        similarity = likeness(self._all, histograms(grey, box))
        best = int(np.argmax(similarity))
        found = float(similarity[best])
        return (self._names[best] if found >= self._min_similarity else None), found


def histograms(grey: Grey, box: Box) -> Histograms:
    """Frequency of each pattern in each cell of a face. Outside the image its edge is repeated.

    :returns: shape (cells × patterns,), the sum of each cell is 1
    """
    rows = np.clip(np.arange(box.top, box.top + box.side), 0, grey.shape[0] - 1)
    columns = np.clip(np.arange(box.left, box.left + box.side), 0, grey.shape[1] - 1)
    how = cv2.INTER_AREA if box.side > _SIDE else cv2.INTER_LINEAR
    face = cv2.resize(np.ascontiguousarray(grey[np.ix_(rows, columns)]), (_SIDE, _SIDE), interpolation=how)
    patterns = local_binary_pattern(np.asarray(face), _POINTS, _RADIUS, method="nri_uniform").astype(np.int64)
    cell = _SIDE // _CELLS
    cells = patterns.reshape(_CELLS, cell, _CELLS, cell).transpose(0, 2, 1, 3).reshape(_CELLS**2, cell**2)
    counted = np.zeros((_CELLS**2, _PATTERNS), dtype=np.float32)
    np.add.at(counted, (np.arange(_CELLS**2)[:, None], cells), 1.0)
    found: Histograms = (counted / np.float32(cell**2)).ravel()
    return found


def likeness(known: Histograms, face: Histograms) -> npt.NDArray[np.float64]:
    """Similarity of a face to others: 1 minus half the χ² distance of the histograms, 0 to 1.

    :param known: shape (faces, cells × patterns)
    :param face: shape (cells × patterns,)
    """
    both = known + face
    apart = np.divide((known - face) ** 2, both, out=np.zeros_like(both), where=both > 0)
    found: npt.NDArray[np.float64] = 1.0 - apart.sum(axis=1, dtype=np.float64) / (2 * _CELLS**2)
    return found


def read_people(folder: Path, finder: FaceFinder, similarity: float = MIN_SIMILARITY) -> KnownFaces:
    """Read known persons from a folder: one image file, or a subfolder of images, for each, named after the person.

    :raises Unavailable: the folder cannot be read, or has no images
    :raises Invalid: a file is not an image, or has no face
    """
    people = KnownFaces(similarity)
    count = 0
    for name, path in _files(folder):
        count += 1
        if count > MAX_IMAGES:
            raise Invalid(f"{folder}: more than {MAX_IMAGES} images")
        if not (0 < len(name) <= LONGEST_NAME and is_printable(name)):
            raise Invalid(
                f"{folder}: '{name[:LONGEST_NAME]}' is no name of 1 to {LONGEST_NAME} printable characters"
            )
        grey = read_grey_image(path)
        boxes = finder.find(grey)
        if not boxes:
            raise Invalid(
                f"{path}: no face found; use an image of an upright face that looks into the camera"
            )
        people.add(name, grey, boxes[0])
    if not count:
        raise Unavailable(f"{folder}: the folder has no images ({', '.join(_KINDS)})")
    return people


def _files(folder: Path) -> list[tuple[str, Path]]:
    try:
        found = [(each.stem, each) for each in folder.iterdir() if each.suffix.lower() in _KINDS]
        for person in folder.iterdir():
            if person.is_dir():
                found += [(person.name, each) for each in person.iterdir() if each.suffix.lower() in _KINDS]
    except OSError as error:
        raise Unavailable(f"{folder}: {error.strerror}") from None
    return sorted(found)


def read_grey_image(path: Path) -> Grey:
    """Read a JPEG or PNG file as grey image.

    :raises Unavailable: it cannot be read
    :raises Invalid: not such an image, or too large
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise Unavailable(f"{path}: {error.strerror}") from None
    if len(data) > MAX_FILE_BYTES:
        raise Invalid(f"{path} is larger than {MAX_FILE_BYTES // 1_000_000} MB")
    try:
        return grey_of(formats.decode_file(data).pixels)
    except SwitchboardError as error:
        raise Invalid(f"{path}: {error}") from None


def grey_of(pixels: Pixels) -> Grey:
    """Convert an image to grey.

    :param pixels: BGR or grey
    """
    return pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)


def find_faces(pixels: Pixels, model: CameraModel, finder: FaceFinder, people: KnownFaces) -> list[SeenFace]:
    """Find and recognise the faces in an image, the largest first.

    :param pixels: BGR or grey
    :param model: camera model for this image size
    """
    grey = grey_of(pixels)
    return recognise_faces(grey, finder.find(grey), model, people)


def recognise_faces(grey: Grey, boxes: list[Box], model: CameraModel, people: KnownFaces) -> list[SeenFace]:
    """Recognise the faces that were found in an image.

    :param model: camera model for this image size
    """
    found = []
    for box in boxes:
        name, similarity = people.recognise(grey, box)
        found.append(SeenFace(box=box, name=name, similarity=similarity, position=_position(box, model)))
    return found


def _position(box: Box, model: CameraModel) -> tuple[float, float, float]:
    """Position of a face of the assumed size. Distortion is ignored: faces differ more."""
    ahead = model.fx * FACE / box.side
    x = (box.left + box.side / 2 - model.cx) / model.fx * ahead
    y = (box.top + box.side / 2 - model.cy) / model.fy * ahead
    return (x, y, ahead)
