"""Point clouds with fewer points: of any fields, in both byte orders; malformed ones are refused in words."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import Invalid
from relay_protocol.ros_types import TypeRegistry
from robot_client.channel import clouds as module
from robot_client.channel.clouds import CloudThinner, read_cloud, thin_cloud
from tests.worlds.robot_channel import ChannelWorld

XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
RGB = np.dtype(
    {
        "names": ["x", "y", "z", "rgb"],
        "formats": ["<f4", "<f4", "<f4", "<u4"],
        "offsets": [0, 4, 8, 16],
        "itemsize": 32,
    }
)
DOUBLES = np.dtype([("ring", "<u2"), ("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("tag", "<i1")])
NUMBERS = {"f4": 7, "f8": 8, "u4": 6, "u2": 4, "i1": 1, "u1": 2, "i4": 5, "i2": 3}


def encoded(
    points: Any, height: int = 1, padding: int = 0, order: str = "<", frame: str = "lidar", **changed: Any
) -> bytes:
    """A cloud in CDR.

    :param padding: bytes behind each row
    :param changed: numbers of the message that are not those of the points
    """
    parts = bytearray(b"\0\1\0\0" if order == "<" else b"\0\0\0\0")

    def u32(value: int) -> None:
        parts.extend(bytes(-(len(parts) - 4) % 4) + struct.pack(f"{order}I", value))

    def text(value: str) -> None:
        data = value.encode() + b"\0"
        u32(len(data))
        parts.extend(data)

    width = len(points) // height
    row = width * points.dtype.itemsize + padding
    for value in (5, 6):
        u32(value)
    text(frame)
    u32(changed.get("rows", height))
    u32(changed.get("width", width))
    u32(len(points.dtype.names))
    for name in points.dtype.names:
        kind, offset = points.dtype.fields[name]
        text(name)
        u32(changed.get("offset", offset))
        parts.append(NUMBERS[kind.str[1:]])
        u32(1)
    parts.append(any(points.dtype.fields[name][0].str[0] == ">" for name in points.dtype.names))
    u32(changed.get("point_step", points.dtype.itemsize))
    u32(changed.get("row_step", row))
    rows = points.reshape(height, width) if points.size else points.reshape(height, 0)
    data = b"".join(each.tobytes() + bytes(padding) for each in rows)
    u32(changed.get("length", len(data)))
    parts.extend(data + b"\1")
    return bytes(parts)


def decoded(body: bytes, dtype: Any) -> Any:
    """The points of a cloud without padding."""
    cloud = read_cloud(body)
    assert cloud.height == 1
    assert cloud.row_step == cloud.width * cloud.point_step == len(cloud.data)
    return np.frombuffer(cloud.data, dtype)


def some(dtype: Any, count: int = 60) -> Any:
    """Points on a line, a metre apart in threes; the other fields are their number."""
    points = np.zeros(count, dtype)
    for name in dtype.names:
        points[name] = np.arange(count) % 100
    points["x"] = np.arange(count) // 3
    points["y"] = points["z"] = -0.5
    return points


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("dtype", [XYZ, RGB, DOUBLES, XYZ.newbyteorder(">"), DOUBLES.newbyteorder(">")])
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (6, 0), (6, 12)])
def test_whole_points_are_kept_with_all_their_fields(
    dtype: Any, order: str, height: int, padding: int
) -> None:
    points = some(dtype)
    body = encoded(points, height, padding, order)
    strided = decoded(thin_cloud(body, link.Thinning(stride=7)), dtype)
    assert strided.tolist() == points[::7].tolist()
    gridded = decoded(thin_cloud(body, link.Thinning(voxel=1.0)), dtype)
    assert gridded.tolist() == points[::3].tolist()


@pytest.mark.parametrize("frame", ["", "a", "ab", "abc", "base_link"])
def test_the_rest_of_the_message_stays_and_other_decoders_read_it(frame: str) -> None:
    types = TypeRegistry()
    rule = "=" * 80 + "\n"
    types.add(
        "sensor_msgs/msg/PointCloud2",
        "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
        + rule
        + "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        + rule
        + "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
        + rule
        + "MSG: sensor_msgs/PointField\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n",
    )
    whole = encoded(some(RGB), 6, 12, frame=frame)
    before, after = (
        json.loads(types.to_json("sensor_msgs/msg/PointCloud2", each))
        for each in (whole, thin_cloud(whole, link.Thinning(stride=2)))
    )
    assert (after["height"], after["width"], after["row_step"]) == (1, 30, 30 * 32)
    changing = ("height", "width", "row_step", "data")
    assert {k: v for k, v in after.items() if k not in changing} == {
        k: v for k, v in before.items() if k not in changing
    }
    assert after["header"]["frame_id"] == frame


def test_points_without_finite_coordinates_are_left_out_of_a_grid_alone() -> None:
    points = some(XYZ, 9)
    points["x"][0], points["y"][4], points["z"][8] = np.nan, np.inf, 1e38
    thinned = decoded(thin_cloud(encoded(points), link.Thinning(voxel=0.001)), XYZ)
    assert thinned["x"].tolist() == [0, 1, 2]
    assert len(decoded(thin_cloud(encoded(points), link.Thinning(stride=2)), XYZ)) == 5


@pytest.mark.parametrize("thinning", [link.Thinning(stride=3), link.Thinning(voxel=0.1)])
def test_an_empty_cloud_stays_empty(thinning: link.Thinning) -> None:
    assert len(decoded(thin_cloud(encoded(some(XYZ, 0)), thinning), XYZ)) == 0


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"", "no CDR"),
        (b"\7\7\0\0", "no CDR"),
        (encoded(some(XYZ))[:40], "shorter than it says"),
        (encoded(some(XYZ))[:-1], "shorter than it says"),
        (encoded(some(XYZ), length=2**31), "shorter than it says"),
        (encoded(some(XYZ), rows=2**31), "bytes of points"),
        (encoded(some(XYZ), width=2**31), "too short for"),
        (encoded(some(XYZ), width=61), "too short for"),
        (encoded(some(XYZ), point_step=0), "no bytes"),
        (encoded(some(XYZ), point_step=2**31), "too short for"),
        (encoded(some(XYZ), row_step=1), "too short for"),
        (encoded(some(XYZ), offset=2**31), "outside a point"),
        (encoded(some(np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<i4")]))), "no coordinate 'z'"),
        (encoded(np.zeros(3, np.dtype([("u", "<f4")]))), "no coordinate 'x'"),
    ],
)
def test_a_malformed_cloud_is_refused_with_a_reason(body: bytes, words: str) -> None:
    with pytest.raises(Invalid, match=words):
        thin_cloud(body, link.Thinning(voxel=0.1))


def test_no_prefix_of_a_cloud_and_no_flipped_byte_raises_another_error() -> None:
    body = encoded(some(RGB, 6), 2, 4)
    broken = [body[:size] for size in range(len(body))]
    broken += [body[:at] + bytes([body[at] ^ 0xFF]) + body[at + 1 :] for at in range(len(body) - 6 * 32)]
    for each in broken:
        for thinning in (link.Thinning(stride=2), link.Thinning(voxel=1.0)):
            try:
                thin_cloud(each, thinning)
            except Invalid:
                continue


def test_the_newest_cloud_waits_while_one_is_thinned() -> None:
    running: list[Callable[[], None]] = []
    out: list[tuple[int, int]] = []
    refused: list[str] = []

    def run(work: Callable[[], bytes]) -> Deferred[bytes]:
        waiting: Deferred[bytes] = Deferred()
        running.append(lambda: Deferred.callback(waiting, work()))
        return waiting

    thinner = CloudThinner(
        link.Thinning(stride=2),
        lambda body, stamp: out.append((read_cloud(body).width, stamp)),
        lambda size, why: refused.append(why),
        lambda: out.append((0, 0)),
        run,
    )
    for stamp in (1, 2, 3):
        thinner.put(encoded(some(XYZ)), stamp)
    running.pop()()
    running.pop()()
    assert out == [(0, 0), (30, 1), (30, 3)], "the one that waited was not reported as dropped"
    thinner.put(encoded(some(XYZ)), 4)
    thinner.close()
    running.pop()()
    assert (len(out), refused) == (3, [])


def test_a_subscription_thins_from_the_robot_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def at_once(work: Callable[[], bytes]) -> Deferred[bytes]:
        waiting: Deferred[bytes] = Deferred()
        try:
            waiting.callback(work())
        except Invalid as error:
            waiting.errback(error)
        return waiting

    monkeypatch.setattr(CloudThinner.__init__, "__defaults__", (at_once,))
    world = ChannelWorld()
    whole = encoded(some(XYZ))

    def subscribe(**fields: Any) -> None:
        world.channel.handle(link.Subscribe(number=4, topic="/points", type=module.TYPE, **fields))

    def sent(body: bytes) -> list[int]:
        world.writer.writes.clear()
        world.platform.emit("/points", body)
        return [len(each) for each in world.writer.writes[0]] if world.writer.writes else []

    subscribe(thin=link.Thinning(stride=10))
    thinned = sent(whole)
    subscribe()
    assert thinned[0] < sent(whole)[0]
    subscribe(thin=link.Thinning(voxel=1.0))
    assert sent(b"\0\1\0\0junk") == []
    (loss,) = [each for each in world.writer.sent if isinstance(each, link.SamplesDropped)]
    assert (loss.number, loss.reason, loss.why) == (4, "not_thinned", "it is shorter than it says")
