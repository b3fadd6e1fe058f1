"""The functions that ship."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from relay_protocol.errors import Invalid
from relay_protocol.functions import FunctionRegistry, decode_value, encode_value
from robot_client.functions import clouds, vision


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
