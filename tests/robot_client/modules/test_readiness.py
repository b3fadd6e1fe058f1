"""When a module is ready by the robot's graph."""

from __future__ import annotations

import pytest

from robot_client.modules.readiness import check_ready, ready_endpoints
from robot_client.modules.settings import ModuleSettings
from tests.worlds.memory_platform import MemoryPlatform

OLD, NEW = b"old", b"new"


@pytest.mark.parametrize("setting", ["ready_topic", "ready_service"])
@pytest.mark.parametrize(
    ("before", "now", "ready"),
    [
        (set(), set(), False),
        (set(), {NEW}, True),
        ({OLD}, {OLD}, False),
        ({OLD}, set(), False),
        ({OLD}, {NEW}, True),
        ({OLD}, {OLD, NEW}, True),
    ],
    ids=[
        "none",
        "first",
        "still the old one",
        "the old one is gone",
        "a new one",
        "the old one and a new one",
    ],
)
def test_module_is_ready_by_an_endpoint_that_was_not_there_before_its_run(
    setting: str, before: set[bytes], now: set[bytes], ready: bool
) -> None:
    platform = MemoryPlatform()
    settings = ModuleSettings(name="m", command=["m"], **{setting: "/there"})
    platform.endpoint_ids["/there"] = before
    began = ready_endpoints(settings, platform)
    platform.endpoint_ids["/there"] = now
    found: list[bool] = []
    check_ready(settings, platform, began).addCallback(found.append)
    assert found == [ready]
