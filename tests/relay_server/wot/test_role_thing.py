"""Elements of Roles as affordances of a Thing."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol.link import Service, Topic
from relay_protocol.rights import Grant, Level, Rules
from relay_server.relay_node.visible_graph import VisibleGraph
from relay_server.roles.schemas import RoleElement
from relay_server.wot.role_thing import RoleRobot, role_description, role_model

GRAPH = VisibleGraph(
    topics={"/lamp": Topic(types=["std_msgs/msg/Bool"]), "/joy": Topic(types=["sensor_msgs/msg/Joy"])},
    services={"/beep": Service(types=["std_srvs/srv/Trigger"]), "/add": Service(types=["x/srv/Add"])},
    actions={},
    nodes=[],
    hidden={},
)


def element(name: str, *resources: str, mappings: tuple[str, ...] = ()) -> RoleElement:
    return RoleElement(name, ["field"], [f"robots/pad/{each}" for each in resources], list(mappings))


def affordances(level: Level, *elements: RoleElement) -> tuple[set[str], set[str], dict[str, Any]]:
    """Names of properties and actions of the Role's elements, and its description."""
    robots = {"pad": RoleRobot(Rules([Grant(level)]), GRAPH)}
    found = role_description("Role", "Role@lab", elements, robots, "https://relay.example")
    properties = found["properties"].keys() - {"role-state"}
    return properties, found["actions"].keys() - {"start-role", "stop-role"}, found


@pytest.mark.parametrize(
    ("resource", "properties", "actions"),
    [
        ("topics/joy#/axes/0", {"E"}, set()),
        ("topics/lamp", {"E"}, {"start-E", "stop-E"}),
        ("services/beep", set(), {"E", "start-E"}),
        ("services/add", set(), {"E"}),
        ("params/node:speed", {"E"}, set()),
        ("actions/dock", set(), {"E", "stop-E"}),
    ],
)
def test_elements_have_their_commands(resource: str, properties: set[str], actions: set[str]) -> None:
    assert affordances(Level.OPERATOR, element("E", resource))[:2] == (properties, actions)


def test_an_element_takes_the_commands_of_what_it_is_mapped_to() -> None:
    mapped = affordances(Level.VIEWER, element("A", mappings=("B", "C")), element("B", "topics/joy"))
    assert mapped[0] == {"A", "B"}


def test_mappings_lead_on_and_either_way_as_for_commands() -> None:
    chain = [element("A"), element("B", mappings=("A", "C")), element("C", "topics/joy")]
    assert affordances(Level.VIEWER, *chain)[0] == {"A", "B", "C"}
    several = element("A", "topics/joy", "topics/lamp", mappings=("B",)), element("B", "topics/joy")
    assert affordances(Level.VIEWER, *several)[0] == {"B"}


def test_only_commands_that_the_reader_may_send_appear() -> None:
    elements = element("JOY", "topics/joy"), element("BEEP", "services/beep")
    properties, actions, found = affordances(Level.VIEWER, *elements)
    assert (properties, actions) == ({"JOY"}, set())
    assert found["properties"]["JOY"]["forms"][0]["op"] == ["readproperty"]
    assert role_model("Role", elements, {})["properties"].keys() == {"role-state"}


def test_a_module_is_judged_by_its_name() -> None:
    allowed = RoleRobot(Rules([Grant(Level.VIEWER, allow=("manage:driver",))]), GRAPH)
    denied = RoleRobot(Rules([Grant(Level.OWNER, deny=("manage:driver",))]), GRAPH)
    for robot, offered in ((allowed, True), (denied, False)):
        found = role_description("R", "R@lab", [element("M", "modules/driver")], {"pad": robot}, "https://r")
        assert ("start-M" in found["actions"]) is offered


def test_a_model_has_no_addresses() -> None:
    robots = {"pad": RoleRobot(Rules([Grant(Level.OPERATOR)]), GRAPH)}
    model = role_model("Role", [element("BEEP", "services/beep")], robots)
    assert model["@type"] == "tm:ThingModel"
    assert "api/v1" not in str(model)
