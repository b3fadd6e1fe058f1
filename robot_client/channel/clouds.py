"""Point clouds with fewer points, for thin links: every n-th point, or one point of each cube of a grid.

Whole points are kept with all their fields, so any fields are possible. The result is unorganised (``height`` 1) and
has no padding between rows. Definition: ``sensor_msgs/msg/PointCloud2``; its encoding is CDR (OMG DDSI-RTPS 2.5,
section 10.2).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred
from twisted.internet.threads import deferToThread

from relay_protocol import link
from relay_protocol.errors import Invalid, SwitchboardError, Unavailable

TYPE = "sensor_msgs/msg/PointCloud2"

MAX_FIELDS = 256
"""Most fields of a point."""

_FLOATS = {7: "f4", 8: "f8"}
"""NumPy's names of the floats of ``PointField.datatype``."""

_AXES = ("x", "y", "z")


class PointField(NamedTuple):
    """:param offset: bytes from the beginning of a point"""

    name: str
    offset: int
    datatype: int
    length: int


class PointCloud(NamedTuple):
    """A cloud as it is encoded.

    :param order: ``<`` or ``>``, of the message's numbers
    :param size_at: where height and width are, bytes from the beginning
    :param tail_at: where ``fields`` begin
    :param row_at: where ``row_step`` is
    :param big_endian: of the points' numbers
    """

    order: str
    size_at: int
    tail_at: int
    row_at: int
    height: int
    width: int
    fields: dict[str, PointField]
    big_endian: bool
    point_step: int
    row_step: int
    data: memoryview
    is_dense: int


class _Reader:
    """Reads CDR; offsets count from behind the header of four bytes."""

    def __init__(self, body: bytes) -> None:
        if len(body) < 4 or body[:2] not in (b"\0\0", b"\0\1"):
            raise Invalid("it is no CDR")
        self.order = "<" if body[1] else ">"
        self.body = body
        self.at = 4

    def align(self, size: int) -> None:
        self.at += -(self.at - 4) % size

    def u32(self) -> int:
        self.align(4)
        return int(struct.unpack_from(f"{self.order}I", self.body, self._advance(4))[0])

    def u8(self) -> int:
        return self.body[self._advance(1)]

    def text(self) -> str:
        length = self.u32()
        at = self._advance(length)
        return bytes(self.body[at : at + max(0, length - 1)]).decode("utf-8", "replace")

    def octets(self) -> memoryview:
        length = self.u32()
        at = self._advance(length)
        return memoryview(self.body)[at : at + length]

    def _advance(self, size: int) -> int:
        at, self.at = self.at, self.at + size
        if self.at > len(self.body):
            raise Invalid("it is shorter than it says")
        return at


def read_cloud(body: bytes) -> PointCloud:
    """Read a cloud, without its points.

    :raises Invalid: it is malformed
    """
    reader = _Reader(body)
    # The header: seconds and nanoseconds of its stamp, frame_id.
    reader.u32()
    reader.u32()
    reader.text()
    reader.align(4)
    size_at = reader.at
    height, width = reader.u32(), reader.u32()
    tail_at = reader.at
    count = reader.u32()
    if count > MAX_FIELDS:
        raise Invalid(f"it has {count} fields, more than {MAX_FIELDS}")
    fields = [PointField(reader.text(), reader.u32(), reader.u8(), reader.u32()) for _ in range(count)]
    big_endian, point_step = bool(reader.u8()), reader.u32()
    row_at = reader.at
    row_step, data, is_dense = reader.u32(), reader.octets(), reader.u8()
    cloud = PointCloud(
        order=reader.order,
        size_at=size_at,
        tail_at=tail_at,
        row_at=row_at,
        height=height,
        width=width,
        fields={each.name: each for each in fields},
        big_endian=big_endian,
        point_step=point_step,
        row_step=row_step,
        data=data,
        is_dense=is_dense,
    )
    _check(cloud)
    return cloud


def _check(cloud: PointCloud) -> None:
    if cloud.height and cloud.width and not cloud.point_step:
        raise Invalid("its points have no bytes")
    if cloud.row_step < cloud.width * cloud.point_step:
        raise Invalid(f"rows of {cloud.row_step} bytes are too short for {cloud.width} points")
    needed = (cloud.height - 1) * cloud.row_step + cloud.width * cloud.point_step if cloud.height else 0
    if len(cloud.data) < needed:
        raise Invalid(f"it has {len(cloud.data)} bytes of points, and needs {needed}")


def thin_cloud(body: bytes, thinning: link.Thinning) -> bytes:
    """A cloud with fewer points.

    :raises Invalid: it is malformed, or has no coordinates for a grid
    :raises Unavailable: NumPy is not installed
    """
    cloud = read_cloud(body)
    points = _points(cloud)
    if thinning.voxel > 0:
        points = points[_first_of_cubes(cloud, points, thinning.voxel)]
    elif thinning.stride > 1:
        points = points[:: thinning.stride]
    return _encode(body, cloud, points)


def _numpy() -> Any:
    try:
        import numpy
    except ImportError:
        raise Unavailable("thinning needs NumPy on the robot: pip install numpy") from None
    return numpy


def _points(cloud: PointCloud) -> Any:
    """The points as an array of rows of bytes: (points, point_step) of uint8."""
    np = _numpy()
    count = cloud.height * cloud.width
    if not count:
        return np.zeros((0, cloud.point_step), np.uint8)
    flat = np.frombuffer(cloud.data, np.uint8)
    strides = (cloud.row_step, cloud.point_step, 1)
    shape = (cloud.height, cloud.width, cloud.point_step)
    rows = np.lib.stride_tricks.as_strided(flat, shape, strides, writeable=False)
    return rows.reshape(count, cloud.point_step)


def _first_of_cubes(cloud: PointCloud, points: Any, side: float) -> Any:
    """Indices of the first point in each cube, in their order; points without finite coordinates are left out.

    :param side: of a cube, in the cloud's unit, metres
    """
    np = _numpy()
    columns = []
    for axis in _AXES:
        kind, offset = _coordinate(cloud, axis)
        size = np.dtype(kind).itemsize
        column = np.ascontiguousarray(points[:, offset : offset + size]).view(kind)[:, 0]
        columns.append(column.astype(np.float64))
    xyz = np.stack(columns, axis=1)
    finite = np.isfinite(xyz).all(axis=1)
    kept = np.flatnonzero(finite)
    cubes = np.floor(xyz[finite] / side)
    # Without cubes whose numbers are not exact any more: such points are as good as infinitely far away.
    near = (np.abs(cubes) < 2**52).all(axis=1)
    kept, cubes = kept[near], cubes[near].astype(np.int64)
    _, first = np.unique(cubes, axis=0, return_index=True)
    return kept[np.sort(first)]


def _coordinate(cloud: PointCloud, axis: str) -> tuple[str, int]:
    field = cloud.fields.get(axis)
    kind = None if field is None else _FLOATS.get(field.datatype)
    if field is None or kind is None:
        raise Invalid(f"it has no coordinate '{axis}' as a float, which a grid needs")
    if field.offset + int(kind[1]) > cloud.point_step:
        raise Invalid(f"its field '{axis}' lies outside a point")
    return (">" if cloud.big_endian else "<") + kind, field.offset


def _encode(body: bytes, cloud: PointCloud, points: Any) -> bytes:
    """The same message with other points. Nothing before ``data`` changes its place."""
    data = points.tobytes()
    pack, count = f"{cloud.order}II", len(points)
    return b"".join(
        (
            body[: cloud.size_at],
            struct.pack(pack, 1, count),
            body[cloud.tail_at : cloud.row_at],
            struct.pack(pack, count * cloud.point_step, len(data)),
            data,
            bytes((cloud.is_dense,)),
        )
    )


Run = Callable[[Callable[[], bytes]], "Deferred[bytes]"]
"""Runs a function in a thread."""


class CloudThinner:
    """Thins the clouds of one subscription in a thread, one at a time; while it is busy the newest one waits.

    :param on_cloud: takes a thinned cloud and its stamp
    :param on_refused: called with the reason why a cloud was not thinned
    :param on_dropped: called when a newer cloud has replaced one that waited
    """

    def __init__(
        self,
        thinning: link.Thinning,
        on_cloud: Callable[[bytes, int], None],
        on_refused: Callable[[int, str], None],
        on_dropped: Callable[[], None],
        run: Run = deferToThread,
    ) -> None:
        self.thinning = thinning
        self._on_cloud = on_cloud
        self._on_refused = on_refused
        self._on_dropped = on_dropped
        self._run = run
        self._busy = False
        self._waiting: tuple[bytes, int] | None = None
        self._closed = False

    def put(self, body: bytes, stamp: int) -> None:
        """Thin a cloud, and pass it on.

        :param stamp: nanoseconds since 1970, when it arrived
        """
        if self._busy:
            if self._waiting is not None:
                self._on_dropped()
            self._waiting = body, stamp
            return
        self._busy = True
        thinning = self.thinning
        thinned = self._run(lambda: thin_cloud(body, thinning))
        thinned.addCallbacks(
            lambda cloud: None if self._closed else self._on_cloud(cloud, stamp),
            lambda failure: self._failed(failure, len(body)),
        )
        thinned.addBoth(self._next)

    def close(self) -> None:
        """The subscription ends; nothing is passed on any more."""
        self._closed = True
        self._waiting = None

    def _failed(self, failure: Any, size: int) -> None:
        if not self._closed:
            known = isinstance(failure.value, SwitchboardError)
            self._on_refused(size, str(failure.value) if known else f"it can't be read: {failure.value}")

    def _next(self, result: Any) -> Any:
        self._busy = False
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self.put(*waiting)
        return result
