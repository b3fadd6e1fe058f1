"""The contact sheet for visual review."""

from __future__ import annotations

from robot_client.camera.formats import ENCODINGS
from tests.robot_client.camera.contact_sheet import sheet, stills
from tests.worlds.image_cards import depth_files


def test_every_encoding_is_on_the_sheet() -> None:
    """In both byte orders, with the files, depth in PNG, edits and H.264."""
    shown = stills()
    titles = [title.partition(",")[0] for title in shown]
    assert {*ENCODINGS, "jpeg", "png", "invert", "h264"} <= set(titles)
    assert {each.strip() for each in depth_files()} <= set(shown)
    assert all(picture.any() for picture in shown.values())
    assert sheet(shown)[-100].max() == 255
