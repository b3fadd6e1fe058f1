"""The substitute for rosbridge's conversion gives the relay's results: both decode the same message."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from bench import rosbridge_way
from bench.codec import Case, cases
from bench.messages import text_of
from relay_protocol.ros_types import TypeRegistry

CASES = {case.type: case for case in cases()}


def alike(ours: Any, theirs: Any) -> bool:
    """Equal, with floats to the precision of float32."""
    if isinstance(ours, dict):
        return ours.keys() == theirs.keys() and all(alike(ours[key], theirs[key]) for key in ours)
    if isinstance(ours, list):
        return len(ours) == len(theirs) and all(map(alike, ours, theirs))
    if isinstance(ours, float):
        return math.isclose(ours, theirs, rel_tol=1e-6)
    return bool(ours == theirs)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_both_conversions_give_the_same_values(case: Case) -> None:
    """The walk, its lean form, and the relay's codec agree on every field of all five messages."""
    from rclpy.serialization import serialize_message

    types = TypeRegistry()
    types.add(case.type, text_of(case.type)[case.type])
    ours = json.loads(types.to_json(case.type, serialize_message(case.message)))
    theirs = rosbridge_way.values(case.message)
    assert alike(ours, theirs)
    assert alike(theirs, rosbridge_way.lean(case.message))
