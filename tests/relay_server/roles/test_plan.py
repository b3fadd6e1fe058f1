"""The parts that are started with a Role, and their order."""

from __future__ import annotations

import msgspec

from relay_server.pipes.schemas import NewPipe
from relay_server.roles.plan import plan_of, unbound
from relay_server.roles.schemas import RoleElement


def element(name: str, *resources: str, kind: str = "field", mappings: tuple[str, ...] = ()) -> RoleElement:
    return RoleElement(name, [kind], list(resources), list(mappings))


def test_modules_come_first_then_devices_then_pipes() -> None:
    parts = plan_of(
        7,
        [
            element("A", "robots/pad/topics/joy#/axes/0", mappings=("X",)),
            element("B", "robots/pad/topics/joy#/axes/1", mappings=("Z",)),
            element("Carrier", "pipes/copy", kind="process"),
            element("Fan", "robots/home/services/fan", kind="process"),
            element("Lamp", "robots/home/topics/lamp/set"),
            element("Driver", "robots/rover/modules/driver", kind="process"),
            element("Again", "robots/rover/modules/driver", kind="software"),
            element("X", "robots/rover/topics/cmd_vel#/linear/x"),
            element("Z", "robots/rover/topics/cmd_vel#/angular/z"),
        ],
    )
    assert [(each.element, each.resource) for each in parts] == [
        ("Driver", "robots/rover/modules/driver"),
        ("Fan", "robots/home/services/fan"),
        ("Carrier", "pipes/copy"),
        ("A → X, B → Z", "pipes/role-7-1"),
    ]
    pipe = msgspec.json.decode(parts[-1].new, type=NewPipe)
    assert (pipe.source.robot, pipe.source.topic) == ("pad", "/joy")
    assert (pipe.target.robot, pipe.target.topic) == ("rover", "/cmd_vel")
    assert [(each.source, each.target) for each in pipe.fields] == [
        ("axes[0]", "linear.x"),
        ("axes[1]", "angular.z"),
    ]
    assert parts[-1].robots == ["pad", "rover"]


def test_whole_messages_are_mapped_as_they_are() -> None:
    (part,) = plan_of(
        1,
        [
            element("A", "robots/one/topics/scan", mappings=("B", "Nothing", "A")),
            element("B", "robots/two/topics/scan"),
        ],
    )
    assert msgspec.json.decode(part.new, type=NewPipe).fields == []


def test_fields_of_services_are_arguments_and_replies() -> None:
    parts = plan_of(
        1,
        [
            element("POWER", "robots/pad/topics/button#/data", mappings=("ON", "Lamp")),
            element("ON", "robots/home/services/lamp/switch#/data"),
            element("DONE", "robots/home/services/lamp/switch#/success", mappings=("LIT", "ON")),
            element("LIT", "robots/pad/topics/lit#/data"),
            element("Lamp", "robots/home/services/lamp/toggle"),
        ],
    )
    pipes = [msgspec.json.decode(each.new, type=NewPipe) for each in parts]
    assert [(each.source.name, each.target.name) for each in pipes] == [
        ("/button", "/lamp/switch"),
        ("/lamp/switch", "/lit"),
    ]
    assert [(each.source.service, each.target.service) for each in pipes] == [
        ("", "/lamp/switch"),
        ("/lamp/switch", ""),
    ]
    assert [each.fields[0].target for each in pipes] == ["data", "data"]


def test_ports_of_programs_are_mapped_as_a_whole_to_messages_and_fields() -> None:
    parts = plan_of(
        1,
        [
            element("POWER", "programs/lamp/ports/power", mappings=("LIT", "Copy")),
            element("LIT", "robots/pad/topics/lit#/data"),
            element("Copy", "robots/pad/topics/copy"),
            element("STICK", "robots/pad/topics/joy#/axes/0", mappings=("DIM", "Toggle")),
            element("DIM", "programs/lamp/ports/level"),
            element("Toggle", "programs/lamp/functions/toggle"),
        ],
    )
    pipes = [msgspec.json.decode(each.new, type=NewPipe) for each in parts]
    assert [(each.source.address, each.target.address) for each in pipes] == [
        ("programs/lamp/ports/power", "pad/lit"),
        ("programs/lamp/ports/power", "pad/copy"),
        ("pad/joy", "programs/lamp/ports/level"),
    ]
    fields = [[(each.source, each.target) for each in pipe.fields] for pipe in pipes]
    assert fields == [[("data", "data")], [], [("axes[0]", "data")]]
    assert [each.robots for each in parts] == [["pad"]] * 3


def test_fields_of_actions_are_in_goals_and_results() -> None:
    parts = plan_of(
        1,
        [
            element("SLOT", "robots/pad/topics/slot#/data", mappings=("DOCK",)),
            element("DOCK", "robots/rover/actions/dock#/slot"),
            element("DONE", "robots/rover/actions/dock#/success", mappings=("LIT",)),
            element("LIT", "robots/pad/topics/lit#/data"),
        ],
    )
    pipes = [msgspec.json.decode(each.new, type=NewPipe) for each in parts]
    assert [(each.source.address, each.target.address) for each in pipes] == [
        ("pad/slot", "rover/dock{}"),
        ("rover/dock{}", "pad/lit"),
    ]


def test_mappings_that_are_impossible_say_why() -> None:
    parts = plan_of(
        1,
        [
            element("A", "robots/one/topics/scan", mappings=("B", "C")),
            element("B", "robots/two/topics/x#/data"),
            element("C", "robots/two/topics/scan"),
            element("D", "robots/one/topics/y#/data", mappings=("E",)),
            element("E", "robots/two/topics/joy#/axes/0"),
        ],
    )
    errors = {each.element: each.error for each in parts}
    assert "a field can't be mapped to a whole message" in errors["A → B"]
    assert errors["A → C"] == ""
    assert errors["D → E"].startswith("this can't be mapped: ")


def test_a_mapping_to_an_element_of_another_role_needs_that_role() -> None:
    elements = [
        element("A", "robots/pad/topics/joy#/axes/0", mappings=("X", "Y", "Nowhere")),
        element("Y", "robots/rover/topics/y#/data"),
        element("Z", mappings=("Y",)),
    ]
    assert unbound(elements) == ["Nowhere", "X", "Z"]
    others = {
        "X": {"Drive": ["robots/rover/topics/x#/data", "robots/rover/modules/m"]},
        "Z": {"Other": ["robots/pad/topics/z#/data"]},
    }
    found = [(each.element, each.needs) for each in plan_of(2, elements, others)]
    assert found == [("A → X", [["Drive"]]), ("A → Y", []), ("Z → Y", [["Other"]])]


def test_any_of_the_roles_that_have_an_element_is_enough() -> None:
    """The same resource in several Roles is carried once; another resource of one of them is carried, too."""
    elements = [element("A", "robots/pad/topics/joy#/axes/0", mappings=("X",))]
    speed, turn = "robots/rover/topics/cmd_vel#/linear/x", "robots/arm/topics/turn#/data"
    others = {"X": {"Drive": [speed], "Ride": [speed, turn]}}
    first, second = plan_of(2, elements, others)
    assert (first.element, first.needs, len(msgspec.json.decode(first.new, type=NewPipe).fields)) == (
        "A → X",
        [["Drive", "Ride"]],
        1,
    )
    assert second.needs == [["Ride"]]
    assert [first.waits_for(each) for each in ([], ["Drive"], ["Ride"])] == ["Drive or Ride", "", ""]
