"""Services, types and actions, in both directions."""

from __future__ import annotations

import base64
import contextlib
import struct
import time

from conformance_suite import case, not_offered
from link_relay import PATIENCE, Link, LinkRelay
from robot_tasks import CDR, FIBONACCI, TRIGGER, TWIST, fibonacci, service, stands


@case("call_service", "SPEC 2.5 call_service")
def test_call(relay: LinkRelay, channel: Link) -> None:
    """A call is answered by one service_response with its id, in the encoding of the call."""
    name = service(relay)
    cdr = "cdr" in relay.hello["encodings"]
    args = {"cdr": base64.b64encode(CDR + b"\0").decode()} if cdr else {"args": {}}
    channel.say("call_service", id="one", service=name, type=TRIGGER, timeout=PATIENCE, **args)
    answer = channel.expect("service_response", id="one")
    assert answer["result"] is True
    if cdr:
        assert base64.b64decode(answer["cdr"], validate=True)[4] in (0, 1)
    else:
        assert isinstance(answer["values"]["success"], bool)


@case("call_service", "SPEC 2.5 service_response, reason")
def test_call_unknown(channel: Link) -> None:
    """A service that does not exist is answered with result false and a reason."""
    args = {"cdr": base64.b64encode(CDR + b"\0").decode(), "args": {}}
    channel.say("call_service", id="two", service="/no/such_service", type=TRIGGER, timeout=0.5, **args)
    answer = channel.expect("service_response", id="two")
    assert answer["result"] is False
    assert answer["reason"]


@case("advertise_service", "SPEC 2.5 advertise_service")
def test_offer_service(relay: LinkRelay) -> None:
    """A service the relay offers is called from the robot's graph, here by another channel, and answered."""
    name = f"/conformance_offer_{time.monotonic_ns()}"
    with relay.channel() as offering, relay.channel() as calling:
        offering.say("advertise_service", service=name, type=TRIGGER, source="a case")
        if not stands(offering, "advertise_service", "advertised_service"):
            not_offered("services of clients in its graph")
        request = {"cdr": base64.b64encode(CDR + b"\0").decode()}
        calling.say("call_service", id="mine", service=name, type=TRIGGER, timeout=PATIENCE, **request)
        asked = offering.expect("call_service", service=name)
        assert asked["type"] == TRIGGER
        answer = base64.b64encode(CDR + b"\1\0\0\0" + struct.pack("<I", 5) + b"here\0").decode()
        offering.say("service_response", id=asked["id"], result=True, cdr=answer)
        reported = calling.expect("service_response", id="mine")
        assert reported["result"] is True
        assert b"here" in base64.b64decode(reported["cdr"])
        offering.say("unadvertise_service", service=name)
        calling.say("call_service", id="gone", service=name, type=TRIGGER, timeout=0.5, **request)
        assert calling.expect("service_response", id="gone")["result"] is False


@case("get_type", "SPEC 2.5 get_type")
def test_get_type(relay: LinkRelay, channel: Link) -> None:
    """type_definition has the text of the type, and of every type in it after 80 = and MSG: name."""
    if "cdr" not in relay.hello["encodings"]:
        not_offered("encodings json only: nobody needs its types")
    channel.say("get_type", type=TWIST)
    reported = channel.expect("type_definition", type=TWIST)
    main, _, rest = reported["text"].partition("\n" + "=" * 80 + "\n")
    assert "Vector3" in main
    assert rest.startswith(("MSG: geometry_msgs/msg/Vector3", "MSG: geometry_msgs/Vector3"))
    assert "float64 x" in rest


@case("get_type", "SPEC 2.5 failed")
def test_get_type_unknown(channel: Link) -> None:
    """A type that does not exist is answered by failed: what, ref, and a reason."""
    channel.say("get_type", type="no_such_package/msg/Thing")
    failed = channel.expect("failed")
    assert (failed["request"], failed["reference"]) == ("get_type", "no_such_package/msg/Thing")
    assert failed["reason"]


@case("get_interfaces", "SPEC 2.5 get_interfaces")
def test_get_interfaces(channel: Link) -> None:
    """get_interfaces is answered by full names, or by failed."""
    channel.say("get_interfaces")
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        with contextlib.suppress(AssertionError):
            channel.expect("failed", 0.1, request="get_interfaces")
            not_offered("the names of its types")
        with contextlib.suppress(AssertionError):
            types = channel.expect("interfaces", 0.1)["types"]
            assert all(len(each.split("/")) == 3 for each in types)
            return
    raise AssertionError("neither 'interfaces' nor 'failed' came")


@case("send_action_goal", "SPEC 2.5 send_action_goal, 0: it never began")
def test_goal_unknown(channel: Link) -> None:
    """A goal on an action that does not exist is answered with status 0, result false and a reason."""
    goal = {"cdr": base64.b64encode(CDR + bytes(4)).decode(), "args": {}}
    channel.say(
        "send_action_goal",
        id="g",
        action="/no/such_action",
        type="example_interfaces/action/Fibonacci",
        **goal,
    )
    result = channel.expect("action_result", id="g")
    assert (result["status"], result["result"]) == (0, False)
    assert result["reason"]


@case("advertise_action", "SPEC 2.5 advertise_action")
def test_offer_action(relay: LinkRelay) -> None:
    """An action the relay offers is used from the robot's graph, here by another channel, up to its result."""
    name = f"/conformance_offer_{time.monotonic_ns()}"
    with relay.channel() as offering, relay.channel() as asking:
        offering.say("advertise_action", action=name, type=FIBONACCI, source="a case")
        if not stands(offering, "advertise_action", "advertised_action"):
            not_offered("actions of clients in its graph")
        goal = base64.b64encode(CDR + struct.pack("<i", 7)).decode()
        asking.say("send_action_goal", id="mine", action=name, type=FIBONACCI, feedback=True, cdr=goal)
        asked = offering.expect("send_action_goal", action=name)
        assert base64.b64decode(asked["cdr"])[4:8] == struct.pack("<i", 7)
        sequence = base64.b64encode(CDR + struct.pack("<2i", 1, 42)).decode()
        offering.say("action_feedback", id=asked["id"], cdr=sequence)
        assert base64.b64decode(asking.expect("action_feedback", id="mine")["cdr"])[4:] == struct.pack(
            "<2i", 1, 42
        )
        offering.say("action_result", id=asked["id"], status=4, result=True, cdr=sequence)
        result = asking.expect("action_result", id="mine")
        assert (result["status"], result["result"]) == (4, True)
        assert base64.b64decode(result["cdr"])[4:] == struct.pack("<2i", 1, 42)


@case("send_action_goal", "SPEC 2.5 send_action_goal")
def test_goal(relay: LinkRelay, channel: Link) -> None:
    """A goal is answered by feedback, where it is wanted, and one result of status 4."""
    fibonacci(relay, channel, 4, feedback=True)
    assert base64.b64decode(channel.expect("action_feedback", id="g")["cdr"])
    result = channel.expect("action_result", id="g")
    assert (result["status"], result["result"]) == (4, True)
    assert base64.b64decode(result["cdr"])[4:] == struct.pack("<6i", 5, 0, 1, 1, 2, 3)


@case("cancel_action_goal", "SPEC 2.5 cancel_action_goal")
def test_cancel(relay: LinkRelay, channel: Link) -> None:
    """A goal that is cancelled ends with a result of status 5."""
    fibonacci(relay, channel, 200, feedback=True)
    channel.expect("action_feedback", id="g")
    channel.say("cancel_action_goal", id="g")
    assert channel.expect("action_result", id="g")["status"] == 5


@case("cancel_action_goal", "SPEC 2.5 cancel_action_goal")
def test_cancel_unknown(channel: Link) -> None:
    """Cancelling an unknown goal has no effect."""
    channel.say("cancel_action_goal", id="never")
    channel.say("ping", t=1)
    channel.expect("pong", t=1)
