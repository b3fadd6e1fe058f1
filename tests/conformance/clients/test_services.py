"""Services: those of the robot called by clients, those of clients called from the graph and by other
clients.
"""

from __future__ import annotations

import json
from typing import Any

import pytest
from conformance_suite import NO_STATUS, Hand, Server, case, fresh_name
from rosbridge_client import ABSENCE, Client

INVERT = "/conformance/invert"
SLOW = "/conformance/slow"
ADD = "/conformance/add_two_ints"
SET_BOOL = "std_srvs/srv/SetBool"
INVERTED = {"success": True, "message": "inverted"}
CALL = "rosbridge v2, 3.3.8 Call Service"
RESPONSE = "rosbridge v2, 3.3.9 Service Response"
OFFER = "rosbridge v2, 3.3.6 Advertise Service"
WITHDRAW = "rosbridge v2, 3.3.7 Unadvertise Service"
VALUES_ARE_AN_OBJECT = "values must be an object, so the call is never answered (service_response.py)"


# --- call_service ---


@case("call_service", CALL)
def test_call(client: Client) -> None:
    """A call with an object of arguments is answered with service, id, result and values."""
    client.send("call_service", id="c1", service=INVERT, args={"data": False})
    answer = client.until("service_response")
    assert answer == {
        "op": "service_response",
        "service": INVERT,
        "id": "c1",
        "result": True,
        "values": INVERTED,
    }


@case("call_service", CALL + ", args")
def test_call_list(client: Client) -> None:
    """Arguments may be a list in the order of the fields."""
    assert client.values(INVERT, [True]) == {"success": False, "message": "inverted"}


@case("call_service", CALL + ", args")
def test_call_list_of_two(client: Client, server: Server) -> None:
    """A list of two arguments fills two fields."""
    server.needs_examples()
    assert client.values(ADD, [3, 4]) == {"sum": 7}


@case("call_service", CALL)
def test_call_example(client: Client, server: Server) -> None:
    """Integers of 64 bits go and come exactly."""
    server.needs_examples()
    assert client.values(ADD, {"a": 2**62, "b": -1}) == {"sum": 2**62 - 1}


@case("call_service", CALL + ", args")
def test_call_without_args(client: Client) -> None:
    """A service without arguments is called without args, with an empty list and with an empty object."""
    for fields in ({}, {"args": []}, {"args": {}}):
        client.send("call_service", id="empty", service="/conformance/nothing", **fields)
        assert client.until("service_response", id="empty")["result"] is True


@case("call_service", "SPEC 1.2 call_service, args")
def test_call_null_args(client: Client) -> None:
    """args may be null."""
    client.send("call_service", id="null", service="/conformance/nothing", args=None)
    assert client.until("service_response", id="null")["result"] is True


@case("call_service", CALL)
def test_call_defaults(client: Client) -> None:
    """Missing arguments take their defaults."""
    assert client.values(INVERT, {}) == INVERTED


@case("call_service", "SPEC 1.2, names and types")
def test_call_old_names(client: Client) -> None:
    """A service without leading slash and a type written pkg/Name are accepted; the answer has the name as
    written.
    """
    client.send(
        "call_service", id="old", service=INVERT.lstrip("/"), type="std_srvs/SetBool", args={"data": False}
    )
    answer = client.until("service_response", id="old")
    assert (answer["service"], answer["result"]) == (INVERT.lstrip("/"), True)


@case("call_service", CALL + ", id")
def test_call_ids(client: Client) -> None:
    """The id comes back as it was, text or number."""
    for name in ("text", 17, "", "ünï💡", 0):
        client.send("call_service", id=name, service=INVERT, args={"data": False})
        answer = client.until("service_response")
        assert answer["id"] == name
        assert type(answer["id"]) is type(name)


@case("call_service", CALL + ", id")
def test_call_without_id(client: Client) -> None:
    """A call without id is answered without one."""
    client.send("call_service", service=INVERT, args={"data": False})
    answer = client.until("service_response")
    assert answer["result"] is True
    assert answer.get("id") is None


@case("call_service", RESPONSE + ", result")
def test_call_unknown(client: Client) -> None:
    """A service that does not exist is answered with result false and a string that says so."""
    answer = client.call(fresh_name("service"), {})
    assert answer["result"] is False
    assert answer["values"]
    assert isinstance(answer["values"], str)


@case("call_service", "SPEC 1.2 call_service, always answered")
def test_call_wrong_args(client: Client) -> None:
    """Arguments that don't fit are answered with result false and a string."""
    for args in ({"data": "yes"}, {"wrong": 1}, [True, False], "text", 7):
        answer = client.call(INVERT, args)
        assert answer["result"] is False, args
        assert isinstance(answer["values"], str)


@case("call_service", "SPEC 1.2 call_service, always answered")
def test_call_wrong_fields(client: Client) -> None:
    """Fields of a wrong type are answered too, with result false and a string, with the id and the name."""
    for number, wrong in enumerate(({"timeout": "x"}, {"fragment_size": "big"}, {"compression": 1})):
        client.send("call_service", id=number, service=INVERT, args={"data": True}, **wrong)
        answer = client.until("service_response", id=number)
        assert (answer["service"], answer["result"]) == (INVERT, False), wrong
        assert isinstance(answer["values"], str)


@case("call_service", "SPEC 1.2 call_service, timeout")
def test_call_timeout(client: Client) -> None:
    """A service that is slower than the timeout is answered with result false and a string."""
    answer = client.call(SLOW, {}, timeout=0.2)
    assert answer["result"] is False
    assert isinstance(answer["values"], str)


@case("call_service", "SPEC 1.2 call_service, timeout")
def test_call_late_answer_is_no_second(client: Client) -> None:
    """A response after the timeout causes no second answer."""
    client.send("call_service", id="late", service=SLOW, timeout=0.2)
    assert client.until("service_response", id="late")["result"] is False
    assert client.values(SLOW)["message"] == "at last"
    client.none("service_response", id="late")


@case("call_service", CALL)
def test_call_out_of_order(client: Client) -> None:
    """A quick call is answered before a slow one that was sent first."""
    client.send("call_service", id="slow", service=SLOW)
    client.send("call_service", id="quick", service=INVERT, args={"data": False})
    assert client.until("service_response")["id"] == "quick"
    assert client.until("service_response")["id"] == "slow"


@case("call_service", CALL)
def test_call_many(client: Client) -> None:
    """Eight calls at once, again and again, are each answered once, each with its own values."""
    # ROS 2 queues ten requests of a service (rmw_qos_profile_services_default).
    for round_ in range(5):
        ids = list(range(round_ * 8, round_ * 8 + 8))
        for number in ids:
            client.send("call_service", id=number, service=INVERT, args={"data": number % 2 == 0})
        answers = [client.until("service_response") for _ in ids]
        assert sorted(each["id"] for each in answers) == ids
        assert all(each["values"]["success"] is (each["id"] % 2 == 1) for each in answers)


@case("call_service", CALL)
def test_call_of_two_clients(client: Client, server: Server) -> None:
    """Two clients that use the same id each get their own answer."""
    with server.connect() as other:
        client.send("call_service", id="same", service=INVERT, args={"data": True})
        other.send("call_service", id="same", service=INVERT, args={"data": False})
        assert client.until("service_response", id="same")["values"]["success"] is False
        assert other.until("service_response", id="same")["values"]["success"] is True


@case("call_service", CALL)
def test_call_nested(client: Client) -> None:
    """Nested messages of the answer, and lists of them, arrive complete."""
    answer = client.values("/conformance/fixture/get_parameters", {"names": ["conformance.number"]})
    assert answer["values"][0]["integer_value"] == 7


@case("call_service", "SPEC 1.2, /relay/ping")
def test_call_relay_ping(client: Client) -> None:
    """The relay's own service /relay/ping is called like any other, with a round trip to the robot."""
    assert client.values("/relay/ping", {"robot": True})["robot_rtt_ms"] >= 0


# --- services that clients offer ---


class Offer:
    """A client that offers a service."""

    def __init__(self, client: Client, hand: Hand) -> None:
        self.name = fresh_name("service")
        self.client = client
        self.hand = hand
        client.send("advertise_service", service=self.name, type=SET_BOOL)
        assert hand.do("offered", self.name, "1") == ["1"], "the service is not in the robot's graph"

    def ask(self, data: bool = True) -> str:
        """The robot calls it; returns the id of its result."""
        return self.hand.ask("call", self.name, SET_BOOL, json.dumps({"data": data}), str(self.hand.waits))

    def called(self, **like: Any) -> dict[str, Any]:
        """The next call sent to the client."""
        return dict(self.client.until("call_service", service=self.name, **like))

    def respond(self, call: dict[str, Any], message: str) -> None:
        """Answers a call."""
        values = {"success": True, "message": message}
        self.client.send("service_response", service=self.name, id=call["id"], result=True, values=values)

    def outcome(self, asked: str) -> dict[str, Any]:
        """The robot's result."""
        (answer,) = self.hand.answer(asked)
        return dict(json.loads(answer))


@pytest.fixture
def offer(client: Client, hand: Hand) -> Offer:
    """A service offered by the case's client."""
    return Offer(client, hand)


@case("advertise_service", OFFER)
def test_offer(offer: Offer) -> None:
    """A call from the robot's graph comes to the client with service, id and args, and its answer goes back."""
    asked = offer.ask(True)
    call = offer.called()
    assert call["id"] not in (None, "")
    assert call["args"] == {"data": True}
    offer.respond(call, "from the client")
    assert offer.outcome(asked) == {"success": True, "message": "from the client"}


@case("advertise_service", "rosbridge_library, advertise_service.py")
def test_offer_fields(offer: Offer) -> None:
    """The call that comes to the client has op, id, service and args, and no other field."""
    asked = offer.ask()
    call = offer.called()
    assert set(call) == {"op", "id", "service", "args"}
    offer.respond(call, "plain")
    assert offer.outcome(asked)["message"] == "plain"


@case("advertise_service", OFFER)
def test_offer_in_parallel(offer: Offer) -> None:
    """Two calls at once come both, and each gets its own answer, in whatever order they are given."""
    first = offer.ask(True)
    one = offer.called()
    second = offer.ask(False)
    two = offer.called()
    assert one["id"] != two["id"]
    offer.respond(two, "second")
    assert offer.outcome(second)["message"] == "second"
    offer.respond(one, "first")
    assert offer.outcome(first)["message"] == "first"


@case("advertise_service", OFFER)
def test_offer_to_clients(offer: Offer, server: Server) -> None:
    """Another client can call it too."""
    with server.connect() as other:
        other.send("call_service", id="between", service=offer.name, type=SET_BOOL, args={"data": False})
        offer.respond(offer.called(args={"data": False}), "between clients")
        answer = other.until("service_response", id="between")
        assert (answer["result"], answer["values"]["message"]) == (True, "between clients")


@case("advertise_service", "SPEC 1.2 advertise_service, an answer from anybody else")
def test_offer_answered_by_another(offer: Offer, server: Server) -> None:
    """An answer from a client that was not asked is not accepted, for any id."""
    asked = offer.ask()
    call = offer.called()
    with server.connect() as other:
        forged = {"success": True, "message": "forged"}
        other.send("service_response", service=offer.name, id=call["id"], result=True, values=forged)
        other.lives()
        offer.respond(call, "genuine")
        assert offer.outcome(asked)["message"] == "genuine"


@case("advertise_service", "SPEC 1.2 advertise_service", suite=NO_STATUS)
def test_answer_to_a_call_that_does_not_exist(reported: Client, hand: Hand) -> None:
    """An answer without a call is refused with a reason."""
    offer = Offer(reported, hand)
    reported.send(
        "service_response", service=offer.name, id="never asked", result=True, values={"success": True}
    )
    assert reported.until("status", level="error")["msg"]


@case("advertise_service", "SPEC 1.2 advertise_service, offered already", suite=NO_STATUS)
def test_offer_taken_by_robot(reported: Client) -> None:
    """A name the robot offers already is an error in words, and the robot's own service goes on."""
    reported.send("advertise_service", service=INVERT, type=SET_BOOL)
    assert reported.until("status", level="error")["msg"]
    assert reported.values(INVERT, {"data": False}) == INVERTED


@case("advertise_service", "SPEC 1.2 advertise_service, offered already", suite=NO_STATUS)
def test_offer_taken_by_client(offer: Offer, server: Server) -> None:
    """A name another client offers already is an error in words, and its service goes on."""
    with server.connect() as other:
        other.send("set_level", level="error")
        other.send("advertise_service", service=offer.name, type=SET_BOOL)
        assert other.until("status", level="error")["msg"]
    asked = offer.ask()
    offer.respond(offer.called(), "still mine")
    assert offer.outcome(asked)["message"] == "still mine"


@case("advertise_service", OFFER, suite=NO_STATUS)
def test_offer_unknown_type(reported: Client) -> None:
    """A type that does not exist is an error in words."""
    reported.send("advertise_service", service=fresh_name("service"), type="std_srvs/srv/NoSuchThing")
    assert reported.until("status", level="error")["msg"]


@case("advertise_service", RESPONSE + ", result", suite=VALUES_ARE_AN_OBJECT)
def test_offer_refuses(offer: Offer, server: Server) -> None:
    """A client that answers with result false makes the other client's call fail with its words."""
    with server.connect() as other:
        other.send("call_service", id="no", service=offer.name, type=SET_BOOL, args={"data": True})
        call = offer.called()
        offer.client.send(
            "service_response", service=offer.name, id=call["id"], result=False, values="not today"
        )
        answer = other.until("service_response", id="no")
        assert answer["result"] is False
        assert isinstance(answer["values"], str)


@case("advertise_service", "SPEC 1.2, one that does not fit the type fails the call")
def test_offer_answers_nonsense(offer: Offer, server: Server) -> None:
    """An answer that does not fit the type makes the call fail in words, and the next one is answered."""
    with server.connect() as other:
        other.send("call_service", id="bad", service=offer.name, type=SET_BOOL, args={"data": True})
        call = offer.called()
        values = {"success": "perhaps", "colour": "blue"}
        offer.client.send("service_response", service=offer.name, id=call["id"], result=True, values=values)
        answer = other.until("service_response", id="bad")
        assert answer["result"] is False
        assert isinstance(answer["values"], str)
        other.send("call_service", id="good", service=offer.name, type=SET_BOOL, args={"data": True})
        offer.respond(offer.called(), "better")
        assert other.until("service_response", id="good")["values"]["message"] == "better"


@case("advertise_service", "SPEC 1.2, a call without an answer ends after its timeout")
def test_offer_never_answers(offer: Offer, server: Server) -> None:
    """A call the client never answers ends after its timeout, result false."""
    with server.connect() as other:
        other.send(
            "call_service", id="lost", service=offer.name, type=SET_BOOL, args={"data": True}, timeout=0.3
        )
        offer.called()
        assert other.until("service_response", id="lost")["result"] is False


@case("advertise_service", "SPEC 1.2; a call is always answered")
def test_offer_client_leaves(hand: Hand, client: Client, server: Server) -> None:
    """When the client that offers leaves during a call, the caller gets an answer, result false, and no hang."""
    with server.connect() as leaving:
        offer = Offer(leaving, hand)
        client.send(
            "call_service", id="left", service=offer.name, type=SET_BOOL, args={"data": True}, timeout=20
        )
        offer.called()
    answer = client.until("service_response", id="left")
    assert answer["result"] is False
    assert isinstance(answer["values"], str)


@case("advertise_service", "SPEC 1.2; a call is always answered")
def test_offer_goes_with_client(hand: Hand, server: Server) -> None:
    """The service of a client that leaves is gone from the robot's graph."""
    with server.connect() as leaving:
        offer = Offer(leaving, hand)
    assert hand.do("offered", offer.name, "0") == ["0"]


@case("advertise_service", "rosapi, services")
def test_offer_is_seen(offer: Offer, server: Server) -> None:
    """Other clients see the service in the graph, with its type."""
    with server.connect() as other:
        assert other.values("/rosapi/service_type", {"service": offer.name})["type"] == SET_BOOL


@case("unadvertise_service", WITHDRAW)
def test_withdraw(offer: Offer) -> None:
    """After unadvertise_service it is gone from the robot's graph."""
    offer.client.send("unadvertise_service", service=offer.name)
    assert offer.hand.do("offered", offer.name, "0") == ["0"]


@case("unadvertise_service", WITHDRAW)
def test_withdraw_and_offer_again(offer: Offer) -> None:
    """A withdrawn service can be offered again."""
    offer.client.send("unadvertise_service", service=offer.name)
    assert offer.hand.do("offered", offer.name, "0") == ["0"]
    offer.client.send("advertise_service", service=offer.name, type=SET_BOOL)
    assert offer.hand.do("offered", offer.name, "1") == ["1"]
    asked = offer.ask()
    offer.respond(offer.called(), "again")
    assert offer.outcome(asked)["message"] == "again"


@case("unadvertise_service", WITHDRAW)
def test_withdraw_of_another(offer: Offer, server: Server) -> None:
    """A client can't withdraw another client's service."""
    with server.connect() as other:
        other.send("unadvertise_service", service=offer.name)
        other.lives()
    asked = offer.ask()
    offer.respond(offer.called(), "still here")
    assert offer.outcome(asked)["message"] == "still here"


@case("unadvertise_service", WITHDRAW)
def test_withdraw_unknown(client: Client) -> None:
    """Withdrawing what was never offered has no effect."""
    client.send("unadvertise_service", service=fresh_name("service"))
    client.lives()
    client.none("service_response", ABSENCE / 3)
