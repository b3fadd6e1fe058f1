"""Faces in pictures: where they are, and whose. Pure but for reading files.

They are found by a cascade of multi-block local binary patterns (L. Zhang et al., "Face Detection Based on Multi-Block
LBP Representation", 2007), OpenCV's, trained on faces from the front; scikit-image has it in its wheel. They are told
apart by histograms of local binary patterns (T. Ahonen et al., "Face Recognition with Local Binary Patterns", 2004).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from skimage.data import lbp_frontal_face_cascade_filename
from skimage.feature import Cascade, local_binary_pattern

from relay_protocol.errors import Invalid, SwitchboardError, Unavailable
from robot_client.camera import formats
from robot_client.camera.formats import Pixels
from robot_client.services.camera_model import CameraModel

FACE = 0.17
"""Metres, the side of the square that is found: from ear to ear of a grown-up."""

WIDTH = 400
"""Pixels; wider pictures are looked at so wide."""
SMALLEST = 24
"""Pixels of a picture that is looked at, the side of the smallest face: what the cascade was trained with."""
SCALES = 1.2
"""From one size of faces that is looked for to the next."""
STEP = 1.3
"""From one place that is looked at to the next, in what is a pixel at the smallest size."""

ALIKE = 0.7
"""How alike, 0 to 1, a face must be to a person's before it is that person's."""

PICTURES = 500
"""Of people, at most."""
LARGEST = 20_000_000
"""Bytes of one of their files."""
LONGEST_NAME = 64
_KINDS = (".jpg", ".jpeg", ".png")

_SIDE, _CELLS, _POINTS, _RADIUS = 112, 7, 8, 2
"""Pixels of a face that is told apart; cells of it in a row; points of a pattern, and how far they are, in pixels."""
_PATTERNS = 59
"""Of 8 points the 58 that are uniform, and the others."""
_SHIFTS = (-0.06, 0.0, 0.06)
"""Shares of a face by which it may be found beside its place."""

Grey = npt.NDArray[np.uint8]
Histograms = npt.NDArray[np.float32]


class Box(NamedTuple):
    """Where a face is, in pixels."""

    left: int
    top: int
    side: int


class SeenFace(NamedTuple):
    """A face in the frame of the camera's picture: x to the right, y down, z ahead (REP 103).

    :ivar box: in the picture
    :ivar name: of the person; ``None`` when it is nobody's that is known
    :ivar alike: to that person's picture, or to the most alike, 0 to 1; 0 where nobody is known
    :ivar position: metres, as if it were as large as :data:`FACE`
    """

    box: Box
    name: str | None
    alike: float
    position: tuple[float, float, float]

    @property
    def distance(self) -> float:
        """Metres from the camera."""
        return math.hypot(*self.position)

    @property
    def bearing(self) -> float:
        """Radians from straight ahead, to the left."""
        x, _, z = self.position
        return math.atan2(-x, z)


class Finder:
    """Finds faces that look into the camera, upright."""

    def __init__(self) -> None:
        self._cascade: Any = Cascade(lbp_frontal_face_cascade_filename())

    def find(self, grey: Grey) -> list[Box]:
        """The faces in a picture, the largest first.

        :param grey: shape (height, width)
        """
        height, width = grey.shape
        factor = min(1.0, WIDTH / width)
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        small = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA)) if factor < 1.0 else grey
        largest = min(small.shape)
        if largest <= SMALLEST:
            return []
        found = self._cascade.detect_multi_scale(
            small.astype(np.float32) / 255,
            scale_factor=SCALES,
            step_ratio=STEP,
            min_size=(SMALLEST, SMALLEST),
            max_size=(largest, largest),
        )
        boxes = [
            Box(round(each["c"] / factor), round(each["r"] / factor), round(each["width"] / factor))
            for each in found
        ]
        return _apart(sorted(boxes, key=lambda box: -box.side))


def _apart(boxes: list[Box]) -> list[Box]:
    """Without those whose middle is in a larger one: they are the same face."""
    kept: list[Box] = []
    for box in boxes:
        x, y = box.left + box.side / 2, box.top + box.side / 2
        if not any(0 < x - each.left < each.side and 0 < y - each.top < each.side for each in kept):
            kept.append(box)
    return kept


class KnownFaces:
    """Persons, by their faces.

    :param alike: how alike a face must be to be one's, 0 to 1
    """

    def __init__(self, alike: float = ALIKE) -> None:
        self._alike = alike
        self._names: list[str] = []
        self._known: list[Histograms] = []
        self._all: Histograms | None = None

    @property
    def names(self) -> list[str]:
        """All of them, in order."""
        return sorted(set(self._names))

    def add(self, name: str, grey: Grey, box: Box) -> None:
        """Know one more face of somebody.

        :param grey: the picture it is in
        """
        for down in _SHIFTS:
            for right in _SHIFTS:
                at = Box(box.left + round(right * box.side), box.top + round(down * box.side), box.side)
                self._names.append(name)
                self._known.append(histograms(grey, at))
        self._all = None

    def who(self, grey: Grey, box: Box) -> tuple[str | None, float]:
        """Whose face it is, and how alike.

        :param grey: the picture it is in
        """
        if not self._known:
            return None, 0.0
        if self._all is None:
            self._all = np.stack(self._known)
        alike = likeness(self._all, histograms(grey, box))
        best = int(np.argmax(alike))
        found = float(alike[best])
        return (self._names[best] if found >= self._alike else None), found


def histograms(grey: Grey, box: Box) -> Histograms:
    """How often each pattern is in each cell of a face; what lies outside the picture repeats its edge.

    :returns: shape (cells × patterns,), of each cell 1 in all
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
    """How alike a face is to others: 1 less half of the χ² between their histograms, 0 to 1.

    :param known: shape (faces, cells × patterns)
    :param face: shape (cells × patterns,)
    """
    both = known + face
    apart = np.divide((known - face) ** 2, both, out=np.zeros_like(both), where=both > 0)
    found: npt.NDArray[np.float64] = 1.0 - apart.sum(axis=1, dtype=np.float64) / (2 * _CELLS**2)
    return found


def read_people(folder: Path, finder: Finder, alike: float = ALIKE) -> KnownFaces:
    """People of a folder: each file of a face is a person of its name, each folder one with several.

    :raises Unavailable: it can't be read, or there is nobody in it
    :raises Invalid: a file that is no picture, or in which no face is found
    """
    people = KnownFaces(alike)
    count = 0
    for name, path in _files(folder):
        count += 1
        if count > PICTURES:
            raise Invalid(f"{folder}: there are more than {PICTURES} pictures")
        if not (0 < len(name) <= LONGEST_NAME and name.isprintable()):
            raise Invalid(f"{folder}: '{name[:LONGEST_NAME]}' can't be a name")
        grey = read_picture(path)
        boxes = finder.find(grey)
        if not boxes:
            raise Invalid(f"{path}: no face is found in it; one is that looks into the camera, upright")
        people.add(name, grey, boxes[0])
    if not count:
        raise Unavailable(f"{folder}: there is no picture in it ({', '.join(_KINDS)})")
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


def read_picture(path: Path) -> Grey:
    """A JPEG or PNG file, grey.

    :raises Unavailable: it can't be read
    :raises Invalid: it is no such picture, or too large
    """
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST + 1)
    except OSError as error:
        raise Unavailable(f"{path}: {error.strerror}") from None
    if len(data) > LARGEST:
        raise Invalid(f"{path} is larger than {LARGEST // 1_000_000} MB")
    try:
        return grey_of(formats.decoded(data).pixels)
    except SwitchboardError as error:
        raise Invalid(f"{path}: {error}") from None


def grey_of(pixels: Pixels) -> Grey:
    """The same picture without colours.

    :param pixels: BGR or grey
    """
    return pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)


def look(pixels: Pixels, lens: CameraModel, finder: Finder, people: KnownFaces) -> list[SeenFace]:
    """The faces in a picture, the largest first.

    :param pixels: BGR or grey
    :param lens: of this picture
    """
    grey = grey_of(pixels)
    return [SeenFace(box, *people.who(grey, box), _position(box, lens)) for box in finder.find(grey)]


def _position(box: Box, lens: CameraModel) -> tuple[float, float, float]:
    """Where a face of the usual size is. Distortion is left out: it is less than faces differ."""
    ahead = lens.fx * FACE / box.side
    x = (box.left + box.side / 2 - lens.cx) / lens.fx * ahead
    y = (box.top + box.side / 2 - lens.cy) / lens.fy * ahead
    return (x, y, ahead)
