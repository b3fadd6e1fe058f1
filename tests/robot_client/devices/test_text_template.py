"""Texts of settings with fields."""

from __future__ import annotations

import pytest

from robot_client.devices.host import WrongSetting, create
from robot_client.devices.target_follower import TargetFollower
from robot_client.devices.text_template import check_template


@pytest.mark.parametrize("text", ["", "Here I am.", "At {name}.", "{name}, {{also}} {name}"])
def test_text_with_known_fields_is_filled_in(text: str) -> None:
    check_template("announce", text, ["name"])
    text.format(name="kitchen")


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("at {place}", "at {place}' has the field {place}; it may have {name}; write {{ and }} for brackets"),
        ("at {}", "has the field {}"),
        ("at {0}", "has the field {0}"),
        ("at {name.__class__}", "has the field {name.__class__}"),
        ("at {name[0]}", "has the field {name[0]}"),
        ("at {name!r}", "has the field {name!r}"),
        ("at {name:d}", "has the field {name:d}"),
        ("at {name:{width}}", "has the field {name:{width}}"),
        ("at {name", "at {name': expected '}' before end of string; it may have {name}"),
        ("at }", "announce = 'at }': Single '}' encountered in format string; it may have {name}"),
    ],
)
def test_text_that_could_not_be_filled_in_is_refused_with_its_fields(text: str, wrong: str) -> None:
    """When the settings of the module are read, not when it first speaks."""
    with pytest.raises(WrongSetting) as refused:
        create(TargetFollower, {"announce": text})
    assert wrong in str(refused.value)
