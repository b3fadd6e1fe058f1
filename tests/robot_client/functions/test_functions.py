"""The functions that ship."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from relay_protocol.errors import Invalid
from relay_protocol.functions import FunctionRegistry, decode_value, encode_value
from robot_client.functions import clouds, vision
from tests.worlds.face_images import EILEEN, scene


def run(name: str, **arguments: Any) -> Any:
    registry = FunctionRegistry()
    registry.add_module(vision)
    registry.add_module(clouds)
    return decode_value(registry.find(name).run(encode_value(arguments)))


def test_points_of_one_cube_become_their_mean() -> None:
    points = np.array([(0, 0, 0), (0.02, 0, 0), (1, 1, 1), (np.nan, 0, 0)], dtype=np.float32)
    found = run("downsample_cloud", points=points, voxel=0.1)
    assert np.allclose(found, [(0.01, 0, 0), (1, 1, 1)])


def test_an_invalid_image_is_refused() -> None:
    with pytest.raises(Invalid, match="can't be read"):
        run("detect_faces", image=b"no image")


def test_frames_are_analysed_in_their_order() -> None:
    dark, light = (vision.encode_jpeg(np.full((120, 160), level, np.uint8)) for level in (10, 200))
    found = run("analyse_frames", frames=[dark, light])
    assert [round(each["brightness"]) for each in found] == [10, 200]


def picture(left: int, top: int, light: float = 1.0) -> bytes:
    """Eileen's face in a scene, as JPEG."""
    return vision.encode_jpeg(scene(EILEEN, 0.8, (left, top), light))


def test_faces_are_found_tracked_and_drawn() -> None:
    before, after = picture(100, 60), picture(112, 66)
    (face,) = run("detect_faces", image=before)
    assert 100 < face["left"] < face["left"] + face["side"] < 340
    tracked = run("track_face", before=before, image=after, face=face)
    assert (tracked["left"] - face["left"], tracked["top"] - face["top"]) == pytest.approx((12, 6), abs=3)
    assert tracked["similarity"] > 0.8
    empty = vision.encode_jpeg(np.full((480, 640), 110, np.uint8))
    assert run("detect_faces", image=empty) == []
    assert run("track_face", before=before, image=empty, face=face) is None

    def decoded(jpeg: bytes) -> Any:
        return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int)

    drawn = decoded(run("annotate_faces", image=before, quality=95))
    changed = np.argwhere(np.abs(drawn - decoded(before)).max(axis=2) > 60)
    top, left = changed.min(axis=0)
    bottom, right = changed.max(axis=0)
    assert (left, top) == pytest.approx((face["left"], face["top"]), abs=4)
    assert (right - left, bottom - top) == pytest.approx((face["side"], face["side"]), abs=8)
    edge = drawn[face["top"] + face["side"] // 2, face["left"]]
    assert edge[1] > 150 > max(edge[0], edge[2])


def test_frames_are_analysed_exhaustively() -> None:
    found = run("analyse_frames", frames=[picture(100, 60), picture(104, 60), picture(104, 60)])
    assert [len(each["faces"]) for each in found] == [1, 1, 1]
    assert [each["motion"] > 0.05 for each in found] == [False, True, False]
    assert all(
        each["keypoints"] > 50 and 0 < each["edges"] < 0.5 and each["sharpness"] > 10 for each in found
    )
