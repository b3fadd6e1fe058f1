"""Parameters of Foxglove clients, by websocket bytes."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Level
from tests.worlds.foxglove_client import Foxglove, FoxgloveWorld
from tests.worlds.relay_node_calls import answers, fails, parameter_services

EVENT = "rcl_interfaces/msg/ParameterEvent"


EVENTS_GRAPH: dict[str, link.Topic | None] = {
    "/parameter_events": link.Topic(types=[EVENT], publishers=["/base"])
}


@pytest.fixture
def tuned() -> FoxgloveWorld:
    """A robot that speaks JSON with the node ``/base`` that has parameters, and an open link."""
    made = FoxgloveWorld()
    made.robot_comes(
        ["json"],
        link.Graph(
            full=True,
            topics=EVENTS_GRAPH,
            services=parameter_services("/base"),
        ),
    )
    return made


VALUES = {
    "speed": {"type": 3, "double_value": 0.5},
    "name": {"type": 4, "string_value": "rover"},
    "gains": {"type": 8, "double_array_value": [1.0, 2.5]},
    "blob": {"type": 5, "byte_array_value": [1, 2, 255]},
    "steps": {"type": 2, "integer_value": 7},
}
SENT = [
    {"name": "/base.speed", "value": 0.5, "type": "float64"},
    {"name": "/base.name", "value": "rover"},
    {"name": "/base.gains", "value": [1.0, 2.5], "type": "float64_array"},
    {"name": "/base.blob", "value": "AQL/", "type": "byte_array"},
    {"name": "/base.steps", "value": 7},
]


def _answers_reads(world: FoxgloveWorld, *names: str) -> None:
    asked = answers(world, "/base/get_parameters", {"values": [VALUES[name] for name in names]})
    assert asked == {"names": list(names)}


def _all_read(world: FoxgloveWorld, client: Foxglove) -> None:
    """Request all parameters; the robot answers."""
    client.sends("getParameters", parameterNames=[], id="all")
    answers(world, "/base/list_parameters", {"result": {"names": list(VALUES), "prefixes": []}})
    _answers_reads(world, *VALUES)


def _events_begin(world: FoxgloveWorld) -> int:
    number = world.link.take(link.Subscribe)[-1].number
    world.subscribed(number, EVENT, "json")
    return number


def test_all_parameters_are_read_once_while_events_come(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    _all_read(tuned, client)
    (answer,) = client.took("parameterValues")
    assert (answer["id"], answer["parameters"]) == ("all", SENT)
    _events_begin(tuned)
    client.sends("getParameters", parameterNames=[], id="again")
    assert client.took("parameterValues")[0]["parameters"] == SENT
    assert not tuned.link.all(link.CallService)
    client.sends("getParameters", parameterNames=["/base.steps", "/base.unset"], id="some")
    answers(tuned, "/base/get_parameters", {"values": [VALUES["steps"], {"type": 0}]})
    assert client.took("parameterValues")[0]["parameters"] == [SENT[4]]


def _requests_all(client: Foxglove) -> None:
    client.sends("getParameters", parameterNames=[], id="all")


def test_clients_share_what_was_read_also_after_a_reconnect(tuned: FoxgloveWorld) -> None:
    ann, bob = tuned.client(), tuned.client(name="bob")
    tuned.robot_joins()
    _requests_all(ann)
    _requests_all(bob)
    assert len(tuned.link.all(link.CallService)) == 1
    answers(tuned, "/base/list_parameters", {"result": {"names": list(VALUES), "prefixes": []}})
    _answers_reads(tuned, *VALUES)
    number = _events_begin(tuned)
    for client in (ann, bob):
        client.transport.abortConnection()
    change = {"name": "steps", "value": {"type": 2, "integer_value": 8}}
    event = {"node": "/base", "new_parameters": [], "changed_parameters": [change], "deleted_parameters": []}
    tuned.channel.sample(number, json.dumps(event).encode(), 1)
    again = Foxglove(tuned.gate, "ann")
    _requests_all(again)
    (answer,) = again.took("parameterValues")
    assert answer["parameters"] == [*SENT[:-1], {"name": "/base.steps", "value": 8}]
    assert not tuned.link.all(link.CallService)
    assert not tuned.link.all(link.Subscribe)


def test_a_read_goes_on_for_others_when_the_client_that_began_it_leaves(tuned: FoxgloveWorld) -> None:
    ann, bob = tuned.client(), tuned.client(name="bob")
    tuned.robot_joins()
    _requests_all(ann)
    _requests_all(bob)
    ann.transport.abortConnection()
    answers(tuned, "/base/list_parameters", {"result": {"names": list(VALUES), "prefixes": []}})
    _answers_reads(tuned, *VALUES)
    assert bob.took("parameterValues")[0]["parameters"] == SENT


def test_a_read_that_is_refused_for_one_client_is_made_for_another(tuned: FoxgloveWorld) -> None:
    ann, bob = tuned.client(), tuned.client(name="bob")
    tuned.robot_joins()
    _requests_all(ann)
    _requests_all(bob)
    requests = tuned.people[0].quota.user.requests
    requests.spend(requests.left)
    for _ in range(2):
        answers(tuned, "/base/list_parameters", {"result": {"names": list(VALUES), "prefixes": []}})
    _answers_reads(tuned, *VALUES)
    assert bob.took("parameterValues")[0]["parameters"] == SENT
    assert any("used up" in each for each in ann.statuses())


def test_a_client_without_the_right_to_events_reads_and_sees_no_problem(tuned: FoxgloveWorld) -> None:
    client = tuned.client(deny=("subscribe:/parameter_events",))
    tuned.robot_joins()
    _all_read(tuned, client)
    number = _events_begin(tuned)
    client.sends("subscribeParameterUpdates", parameterNames=["/base.steps"])
    change = {"name": "steps", "value": {"type": 2, "integer_value": 8}}
    event = {"node": "/base", "new_parameters": [], "changed_parameters": [change], "deleted_parameters": []}
    tuned.channel.sample(number, json.dumps(event).encode(), 1)
    _requests_all(client)
    messages = [each for each in client.take() if isinstance(each, dict)]
    assert [each.get("id") for each in messages if each["op"] == "parameterValues"] == ["all", "all"]
    assert not [each for each in messages if each["op"] == "status"]
    assert tuned.people[0].refusals == 0


def test_parameters_are_forgotten_when_events_end(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    _all_read(tuned, client)
    number = _events_begin(tuned)
    tuned.person()
    client.transport.abortConnection()
    tuned.clock.advance(61)
    assert [each.number for each in tuned.link.take(link.Unsubscribe)] == [number]
    client = Foxglove(tuned.gate, "ann")
    _all_read(tuned, client)
    tuned.robot_goes()
    tuned.robot_comes(
        ["json"], link.Graph(full=True, services=parameter_services("/base"), topics=EVENTS_GRAPH)
    )
    tuned.robot_joins()
    client.take()
    _all_read(tuned, client)
    assert client.took("parameterValues")[0]["parameters"] == SENT


def test_followed_parameters_are_sent_by_events(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    _all_read(tuned, client)
    number = _events_begin(tuned)
    client.sends("subscribeParameterUpdates", parameterNames=["/base.speed", "/base.name"])
    client.take()
    event = {
        "node": "/base",
        "new_parameters": [],
        "changed_parameters": [
            {"name": "speed", "value": {"type": 3, "double_value": 1.5}},
            {"name": "steps", "value": {"type": 2, "integer_value": 8}},
        ],
        "deleted_parameters": [{"name": "name", "value": {"type": 0}}],
    }
    tuned.channel.sample(number, json.dumps(event).encode(), 1)
    (update,) = client.took("parameterValues")
    assert update["parameters"] == [
        {"name": "/base.speed", "value": 1.5, "type": "float64"},
        {"name": "/base.name"},
    ]
    client.sends("getParameters", parameterNames=[], id="x")
    found = {each["name"]: each["value"] for each in client.took("parameterValues")[0]["parameters"]}
    assert found["/base.steps"] == 8
    assert "/base.name" not in found
    client.sends("unsubscribeParameterUpdates", parameterNames=[])
    tuned.channel.sample(number, json.dumps(event).encode(), 2)
    assert not client.took("parameterValues")
    client.sends("subscribeParameterUpdates", parameterNames=[])
    tuned.channel.sample(number, json.dumps(event).encode(), 3)
    (update,) = client.took("parameterValues")
    assert [each["name"] for each in update["parameters"]] == ["/base.speed", "/base.steps", "/base.name"]
    client.sends("unsubscribeParameterUpdates", parameterNames=[])
    tuned.channel.sample(number, json.dumps(event).encode(), 4)
    assert not client.took("parameterValues")


def _updated(world: FoxgloveWorld, number: int, client: Foxglove) -> list[str]:
    """Names of the parameters that a client gets when two of them change."""
    _event(
        world,
        number,
        changed_parameters=[
            {"name": "speed", "value": VALUES["speed"]},
            {"name": "steps", "value": _steps(8)},
        ],
    )
    return [each["name"] for update in client.took("parameterValues") for each in update["parameters"]]


def test_of_all_parameters_that_are_followed_some_can_be_left_out_by_name(tuned: FoxgloveWorld) -> None:
    """Following all stands for a subscription of each parameter, so each can be ended."""
    client = tuned.client()
    tuned.robot_joins()
    _all_read(tuned, client)
    number = _events_begin(tuned)
    for names in (["/base.speed"], []):
        client.sends("subscribeParameterUpdates", parameterNames=names)
    client.sends("unsubscribeParameterUpdates", parameterNames=["base.speed"])
    client.take()
    assert _updated(tuned, number, client) == ["/base.steps"]
    client.sends("subscribeParameterUpdates", parameterNames=["/base.speed"])
    client.sends("unsubscribeParameterUpdates", parameterNames=["/base.steps"])
    assert _updated(tuned, number, client) == ["/base.speed"]
    client.sends("subscribeParameterUpdates", parameterNames=[])
    assert _updated(tuned, number, client) == ["/base.speed", "/base.steps"]


def test_the_parameters_that_are_left_out_are_bounded(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    client.sends("subscribeParameterUpdates", parameterNames=[])
    client.take()
    for first in (0, 4000):
        names = [f"/base.p{n}" for n in range(first, first + 4000)]
        client.sends("unsubscribeParameterUpdates", parameterNames=names)
    assert client.statuses() == ["at most 4096 parameters can be left out when all are followed"]


def _passes(world: FoxgloveWorld, client: Foxglove, seconds: int) -> None:
    """Time passes, while the client answers pings."""
    for _ in range(seconds):
        world.clock.advance(1)
        client.take()


def _requests(client: Foxglove, *names: str) -> None:
    client.sends("getParameters", parameterNames=[f"/base.{name}" for name in names], id="named")


@pytest.mark.parametrize("all_first", [False, True])
def test_named_parameters_are_kept_for_a_minute_after_each_read(
    tuned: FoxgloveWorld, all_first: bool
) -> None:
    client = tuned.client()
    tuned.robot_joins()
    if all_first:
        _all_read(tuned, client)
    else:
        _requests(client, "name")
        _answers_reads(tuned, "name")
    number = _events_begin(tuned)
    for minute in range(3):
        if minute or not all_first:
            _requests(client, "steps")
            _answers_reads(tuned, "steps")
        _passes(tuned, client, 50)
        _requests(client, "steps")
        assert [each["id"] for each in client.took("parameterValues")] == ["named"]
        assert not tuned.link.all(link.CallService)
        _passes(tuned, client, 10)
    _requests(client, "name", "steps")
    _answers_reads(tuned, "name", "steps")
    _event(tuned, number, changed_parameters=[{"name": "steps", "value": _steps(9)}])
    client.take()
    _requests(client, "name", "steps")
    (answer,) = client.took("parameterValues")
    assert answer["parameters"][1] == {"name": "/base.steps", "value": 9}


def test_a_read_of_some_parameters_does_not_keep_the_others(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    _all_read(tuned, client)
    _events_begin(tuned)
    _passes(tuned, client, 60)
    _requests(client, "steps")
    _answers_reads(tuned, "steps")
    _requests(client, "name")
    _answers_reads(tuned, "name")
    _all_read(tuned, client)


def test_that_a_parameter_is_not_set_is_kept_until_it_is_set(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    _requests(client, "steps", "unset")
    answers(tuned, "/base/get_parameters", {"values": [VALUES["steps"], {"type": 0}]})
    number = _events_begin(tuned)
    client.take()
    for _ in range(2):
        _requests(client, "steps", "unset")
        assert [len(each["parameters"]) for each in client.took("parameterValues")] == [1]
    _event(tuned, number, new_parameters=[{"name": "unset", "value": _steps(9)}])
    _event(tuned, number, deleted_parameters=[{"name": "steps"}])
    client.take()
    _requests(client, "steps", "unset")
    assert [each["parameters"] for each in client.took("parameterValues")] == [
        [{"name": "/base.unset", "value": 9}]
    ]
    assert not tuned.link.all(link.CallService)
    _passes(tuned, client, 60)
    _requests(client, "unset")
    assert tuned.link.all(link.CallService)


def test_names_that_are_kept_as_not_set_are_bounded(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    names = [f"unset{n}" for n in range(257)]
    _requests(client, *names)
    answers(tuned, "/base/get_parameters", {"values": [{"type": 0} for _ in names]})
    _events_begin(tuned)
    _requests(client, *names[1:])
    assert not tuned.link.all(link.CallService)
    for name in (names[0], "x" * 256):
        _requests(client, name)
        answers(tuned, "/base/get_parameters", {"values": [{"type": 0}]})
    _requests(client, "x" * 256)
    assert tuned.link.all(link.CallService)


def _steps(value: int) -> dict[str, Any]:
    return {"type": 2, "integer_value": value}


def _event(world: FoxgloveWorld, number: int, **lists: list[dict[str, Any]]) -> None:
    """A change of parameters arrives."""
    empty: dict[str, Any] = {"new_parameters": [], "changed_parameters": [], "deleted_parameters": []}
    world.channel.sample(number, json.dumps({"node": "/base", **empty, **lists}).encode(), 1)


@pytest.mark.parametrize("names", [[], ["/base.steps", "/base.name"]], ids=["all", "named"])
@pytest.mark.parametrize("is_known", [False, True])
def test_a_change_that_comes_while_a_read_waits_is_not_overwritten_by_it(
    tuned: FoxgloveWorld, names: list[str], is_known: bool
) -> None:
    """The node has answered before the change, and the answer arrives behind its event."""
    client = tuned.client()
    tuned.robot_joins()
    client.sends("getParameters", parameterNames=["/base.speed"], id="first")
    number = _events_begin(tuned)
    if is_known:
        _answers_reads(tuned, "speed")
    client.sends("getParameters", parameterNames=names, id="x")
    if not names:
        answers(tuned, "/base/list_parameters", {"result": {"names": ["steps", "name"], "prefixes": []}})
    client.take()
    _event(
        tuned,
        number,
        new_parameters=[{"name": "gains", "value": VALUES["gains"]}],
        changed_parameters=[{"name": "steps", "value": _steps(8)}],
        deleted_parameters=[{"name": "name", "value": {"type": 0}}],
    )
    if not is_known:
        _answers_reads(tuned, "speed")
    _answers_reads(tuned, "steps", "name")
    (answer,) = [each for each in client.took("parameterValues") if each["id"] == "x"]
    found = {each["name"]: each["value"] for each in answer["parameters"]}
    assert found["/base.steps"] == 8
    assert "/base.name" not in found
    assert names or found["/base.gains"] == [1.0, 2.5]


def test_of_two_reads_the_one_that_began_last_counts(tuned: FoxgloveWorld) -> None:
    """Their answers come in the other order."""
    client = tuned.client()
    tuned.robot_joins()
    _all_read(tuned, client)
    _events_begin(tuned)
    client.sends("getParameters", parameterNames=["/base.steps", "/base.unset"], id="old")
    (old,) = tuned.link.take(link.CallService)
    client.sends("setParameters", parameters=[{"name": "/base.steps", "value": "8"}], id="set")
    answers(tuned, "/base/set_parameters", {"results": [{"successful": True, "reason": ""}]})
    answers(tuned, "/base/get_parameters", {"values": [_steps(8)]})
    tuned.link.said.append(old)
    answers(tuned, "/base/get_parameters", {"values": [_steps(7), {"type": 0}]})
    found = {each["id"]: each["parameters"] for each in client.took("parameterValues") if "id" in each}
    assert found["set"] == found["old"] == [{"name": "/base.steps", "value": 8}]


def test_parameters_without_a_leading_slash_are_answered_as_they_are_spelt(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    client.sends("getParameters", parameterNames=["base.steps", ".", "/", "base", "/.x"], id="some")
    _answers_reads(tuned, "steps")
    assert client.took("parameterValues")[0]["parameters"] == [{"name": "base.steps", "value": 7}]
    number = _events_begin(tuned)
    client.sends("subscribeParameterUpdates", parameterNames=["base.steps"])
    change = {"name": "steps", "value": {"type": 2, "integer_value": 8}}
    event = {"node": "/base", "new_parameters": [], "changed_parameters": [change], "deleted_parameters": []}
    tuned.channel.sample(number, json.dumps(event).encode(), 1)
    assert client.took("parameterValues")[0]["parameters"] == [{"name": "base.steps", "value": 8}]
    client.sends("unsubscribeParameterUpdates", parameterNames=["no parameter"])
    tuned.channel.sample(number, json.dumps(event).encode(), 2)
    assert client.took("parameterValues")
    client.sends("unsubscribeParameterUpdates", parameterNames=["/base.steps"])
    tuned.channel.sample(number, json.dumps(event).encode(), 3)
    assert not client.took("parameterValues")


@pytest.mark.parametrize(
    ("entry", "sent"),
    [
        ({"value": 1, "type": "float64"}, {"type": 3, "double_value": 1}),
        ({"value": [1, 2], "type": "float64_array"}, {"type": 8, "double_array_value": [1, 2]}),
        ({"value": "AQI=", "type": "byte_array"}, {"type": 5, "byte_array_value": [1, 2]}),
        ({"value": math.nan, "type": "float64"}, {"type": 3, "double_value": None}),
        (
            {"value": [1.5, -math.inf], "type": "float64_array"},
            {"type": 8, "double_array_value": [1.5, None]},
        ),
        ({"value": "fast"}, {"type": 4, "string_value": "fast"}),
        ({"value": True}, {"type": 1, "bool_value": True}),
        ({}, {"type": 0}),
    ],
)
def test_a_parameter_is_set_and_its_value_comes_back(tuned: FoxgloveWorld, entry: Any, sent: Any) -> None:
    client = tuned.client()
    tuned.robot_joins()
    client.sends("setParameters", parameters=[{"name": "/base.speed", **entry}], id="set")
    asked = answers(tuned, "/base/set_parameters", {"results": [{"successful": True, "reason": ""}]})
    assert asked == {"parameters": [{"name": "speed", "value": sent}]}
    _answers_reads(tuned, "speed")
    (answer,) = client.took("parameterValues")
    assert (answer["id"], answer["parameters"]) == ("set", [SENT[0]])


def test_a_name_that_is_no_parameter_does_not_keep_others_from_being_set(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    entries = [{"name": name, "value": "fast"} for name in ("speed", "/base.speed", "/.x")]
    client.sends("setParameters", parameters=entries, id="set")
    asked = answers(tuned, "/base/set_parameters", {"results": [{"successful": True, "reason": ""}]})
    assert [each["name"] for each in asked["parameters"]] == ["speed"]
    _answers_reads(tuned, "speed")
    messages = [each for each in client.take() if isinstance(each, dict)]
    assert [each["message"] for each in messages if each["op"] == "status" and each["level"] == 2] == [
        f"parameters: '{name}' is no parameter; write /node.parameter" for name in ("speed", "/.x")
    ]
    (answer,) = [each for each in messages if each["op"] == "parameterValues"]
    assert (answer["id"], answer["parameters"]) == ("set", [SENT[0]])
    assert tuned.people[0].refusals == 2


def test_setting_only_what_is_no_parameter_is_answered_with_no_values(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    client.sends("setParameters", parameters=[{"name": "speed", "value": 1}], id="set")
    (answer,) = client.took("parameterValues")
    assert (answer["id"], answer["parameters"]) == ("set", [])


def test_nan_elsewhere_in_a_message_is_refused_with_a_reason(tuned: FoxgloveWorld) -> None:
    """It does not count as malformed."""
    client = tuned.client()
    tuned.robot_joins()
    for _ in range(60):
        client.sends("getParameters", parameterNames=[], id=math.nan)
    assert "id: NaN and infinity are not JSON" in client.statuses()[-1]
    client.sends("getParameters", parameterNames=["/base.speed"], id="x")
    _answers_reads(tuned, "speed")


def test_an_integer_of_no_stated_type_takes_the_type_that_the_parameter_has(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    client.sends("setParameters", parameters=[{"name": "/base.speed", "value": 2}])
    _answers_reads(tuned, "speed")
    asked = answers(tuned, "/base/set_parameters", {"results": [{"successful": False, "reason": "too fast"}]})
    assert asked["parameters"][0]["value"] == {"type": 3, "double_value": 2}
    assert client.statuses()[-1] == "set parameters of /base: speed: too fast"
    assert not client.took("parameterValues")


def test_a_viewer_without_the_right_to_call_sets_nothing(tuned: FoxgloveWorld) -> None:
    viewer = tuned.client(Level.VIEWER)
    tuned.robot_joins()
    viewer.sends("setParameters", parameters=[{"name": "/base.speed", "value": True}])
    assert not tuned.link.all(link.CallService)
    assert any("set parameters of /base" in each for each in viewer.statuses())


def test_a_long_array_of_bytes_is_refused_before_it_is_decoded(tuned: FoxgloveWorld) -> None:
    """A viewer is refused before that, whatever the value."""
    owner, viewer = tuned.client(), tuned.client(Level.VIEWER)
    tuned.robot_joins()
    entry = {"name": "/base.speed", "type": "byte_array", "value": "!" * 2_000_000}
    for client, words in ((owner, "may have 65536 bytes"), (viewer, "call")):
        client.sends("setParameters", parameters=[entry])
        assert any(words in each for each in client.statuses())
    assert not [each for each in tuned.link.all(link.CallService) if each.service == "/base/set_parameters"]


def test_values_that_were_read_are_not_sent_when_the_right_to_read_them_is_gone(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    _all_read(tuned, client)
    _events_begin(tuned)
    client.take()
    permit = tuned.gate.permits["ann"]
    permit.rules = tuned.permit(Level.OPERATOR, deny=("call:/base/*",)).rules
    permit.on_change()
    for names in ([], ["/base.speed"]):
        client.sends("getParameters", parameterNames=names, id="again")
        (answer,) = client.took("parameterValues")
        assert answer["parameters"] == []


def test_values_of_a_node_that_can_not_be_read_any_more_are_not_sent(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    _all_read(tuned, client)
    _events_begin(tuned)
    client.take()
    client.sends("getParameters", parameterNames=["/base.unset"], id="some")
    fails(tuned, "/base/get_parameters", "the node is gone")
    assert client.took("parameterValues")[0]["parameters"] == []
    client.sends("getParameters", parameterNames=["/base.speed"], id="again")
    fails(tuned, "/base/get_parameters", "the node is gone")
    assert client.took("parameterValues")[0]["parameters"] == []


def test_each_node_that_refuses_a_parameter_has_a_status_of_its_own(tuned: FoxgloveWorld) -> None:
    client = tuned.client()
    tuned.robot_joins()
    nodes = ("/base", "/arm")
    tuned.registry.graph(
        tuned.robot, link.Graph(services=parameter_services("/base") | parameter_services("/arm"))
    )
    client.take()
    entries = [{"name": f"{node}.speed", "value": "fast"} for node in nodes]
    client.sends("setParameters", parameters=entries)
    for node in nodes:
        answers(tuned, f"{node}/set_parameters", {"results": [{"successful": False, "reason": "no"}]})
    ids = [each["id"] for each in client.took("status")]
    assert ids == ["parameters-set:/base", "parameters-set:/arm"]
