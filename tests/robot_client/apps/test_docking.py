"""Battery, markers and scanner on the path to a charger."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from robot_client.apps.recharge import (
    Approach,
    Charge,
    ChargeNeed,
    Sighting,
    clearance_ahead,
    parse_battery,
    parse_marker,
)


@pytest.mark.parametrize(
    ("share", "status", "reported"),
    [
        (0.5, 2, Charge(0.5, 2)),
        (1, 4, Charge(1.0, 4)),
        (0.5, None, Charge(0.5, 0)),
        (None, 2, None),
        (50.0, 2, None),
        ("0.5", 2, None),
    ],
)
def test_a_battery_has_a_charge_or_none(share: Any, status: Any, reported: Charge | None) -> None:
    """NaN arrives as null; percentages are invalid."""
    assert parse_battery({"percentage": share, "power_supply_status": status}) == reported


def test_a_battery_needs_charging_from_low_until_it_has_enough() -> None:
    """Between the thresholds the state stays; a full battery is charged enough."""
    need = ChargeNeed(0.2, 0.8)
    wanted = [(0.5, False), (0.19, True), (0.5, True), (0.79, True), (0.8, False), (0.3, False), (0.1, True)]
    for share, urgent in wanted:
        need.update(Charge(share, 2))
        assert need.urgent is urgent
    need.update(Charge(0.1, 4))
    assert not need.urgent


def seen(*markers: Any) -> str:
    return json.dumps({"stamp": 1.0, "frame": "camera", "markers": list(markers)})


def test_a_marker_is_found_by_its_number() -> None:
    """Among others; it may be missing."""
    text = seen({"id": 1, "distance": 1.0, "bearing": 0.0}, {"id": 7, "distance": 2.5, "bearing": -0.2})
    assert parse_marker(text, 7) == Sighting(2.5, -0.2)
    assert parse_marker(text, 3) is None


@pytest.mark.parametrize(
    "text",
    [
        None,
        7,
        "no json",
        "[]",
        "{}",
        '{"markers": 3}',
        '{"markers": [3]}',
        '{"markers": [{"id": 7}]}',
        seen({"id": 7, "distance": "far", "bearing": 0.0}),
        seen({"id": 7, "distance": -1.0, "bearing": 0.0}),
        '{"markers": [{"id": 7, "distance": NaN, "bearing": 0.0}]}',
        '{"markers": [{"id": 7, "distance": 1.0, "bearing": Infinity}]}',
    ],
)
def test_invalid_bits_are_no_marker(text: Any) -> None:
    """For any message on the topic."""
    assert parse_marker(text, 7) is None


def scan(*ranges: Any, begin: float = 0.0, step: float = math.pi / 2) -> dict[str, Any]:
    return {"ranges": list(ranges), "angle_min": begin, "angle_increment": step}


def test_obstacle_ahead_blocks() -> None:
    """Obstacles beside and behind do not, nor do missing ones."""
    assert clearance_ahead(scan(0.8, 0.1, 0.1, 0.1)) == pytest.approx(0.8)
    assert clearance_ahead(scan(None, 0.3, 0.2, None)) == math.inf
    aside = math.radians(30)
    assert clearance_ahead(scan(0.4, begin=aside)) == pytest.approx(0.4 * math.cos(aside))
    assert clearance_ahead(scan(1.0, begin=aside)) == math.inf


@pytest.mark.parametrize(
    "message", [{}, scan(), scan(None, None), scan("a"), {"ranges": 3, "angle_min": 0, "angle_increment": 1}]
)
def test_a_scan_without_ranges_is_none(message: dict[str, Any]) -> None:
    """Without a valid ray, or without any ray."""
    assert clearance_ahead(message) is None


def test_it_drives_slower_the_nearer_it_is_and_turns_to_the_marker() -> None:
    """Never faster than its limit; first it turns to a marker far aside."""
    approach = Approach(0.45, 0.3, 0.5)
    assert approach.command(Sighting(3.0, 0.1)) == (0.3, pytest.approx(0.15))
    speeds = [approach.command(Sighting(each, 0.0)).speed for each in (1.2, 0.8, 0.6, 0.46)]
    assert speeds == sorted(speeds, reverse=True) and speeds[-1] > 0.0
    assert approach.command(Sighting(3.0, 1.0)) == (0.0, 0.5)
    assert approach.command(Sighting(3.0, -1.0)) == (0.0, -0.5)
    assert approach.command(Sighting(0.45, 0.3)) == (0.0, 0.0)
    assert approach.arrived(Sighting(0.44, 0.0)) and not approach.arrived(Sighting(0.5, 0.0))
