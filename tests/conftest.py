"""How the tests share a machine of two cores: those that start processes take turns, the others run beside them."""

from __future__ import annotations

from pathlib import Path

import pytest

HERE = Path(__file__).parent
WITH_PROCESSES = tuple(
    HERE / each
    for each in (
        "bench",
        "conformance",
        "e2e",
        "robot_client",
        "scripts",
        "web_client",
        "relay_server/cli",
        "test_installation.py",
    )
)
"""Relays, robots, browsers: two such tests at a time would measure each other."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests that start processes into one group, which one worker of pytest-xdist runs in order."""
    for item in items:
        if any(item.path.is_relative_to(each) for each in WITH_PROCESSES):
            item.add_marker(pytest.mark.xdist_group("processes"))
