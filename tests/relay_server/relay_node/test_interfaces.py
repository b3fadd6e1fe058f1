"""Interfaces of the relay's own services and topics."""

from __future__ import annotations

import msgspec
import pytest

from relay_protocol import link
from relay_server.relay_node.interfaces import SERVICES, STATUS, TYPE_NAMES, TYPES
from tests.worlds.specification import SPEC, section

SECTION = section("1")


def test_the_contract_names_every_service_of_rosapi() -> None:
    """And no others."""
    for name in SERVICES:
        if name.startswith("/rosapi/"):
            assert f"`{name.removeprefix('/rosapi/')}`" in SECTION


@pytest.mark.parametrize(
    "type_name",
    [
        STATUS,
        "switchboard_msgs/srv/Ping_Request",
        "switchboard_msgs/srv/Ping_Response",
        "switchboard_msgs/srv/Stop_Request",
        "switchboard_msgs/srv/Stop_Response",
    ],
)
def test_the_contract_names_every_field_of_the_relays_own_types(type_name: str) -> None:
    """Types of the robot are in section 2.4."""
    for typedef in TYPES.typedefs(type_name):
        section = SPEC if typedef["type"].endswith(("/Motion", "/Health")) else SECTION
        for field in typedef["fieldnames"]:
            assert f"`{field}`" in section, (typedef["type"], field)


def test_the_status_has_all_health_values_of_a_robot() -> None:
    """Field by field, in their order."""
    (reported,) = (each for each in TYPES.typedefs(STATUS) if each["type"].endswith("/Health"))
    assert reported["fieldnames"] == [each.name for each in msgspec.structs.fields(link.Health)]


def test_every_type_is_known_by_its_own_text() -> None:
    """A client may request each text, as for any type of the robot."""
    for type_name in TYPE_NAMES:
        assert TYPES.has_text(type_name)
        assert TYPES.definition(type_name)
