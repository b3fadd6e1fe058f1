"""Rules for every operation: status, errors, limits, credentials, the address itself."""

from __future__ import annotations

import contextlib
import json
import urllib.request
from typing import Any

import pytest
from conformance_suite import NO_STATUS, Server, case, fresh_name
from rosbridge_client import ABSENCE, Client
from websockets.exceptions import ConnectionClosed, InvalidStatus

ENVELOPE = "rosbridge v2, 1 The rosbridge transport"
ERRORS = "SPEC 1.3 Errors"
BINARY_IS_TEXT = "a binary message is taken as text (rosbridge_server/websocket_handler.py, on_message)"
NO_1007 = "the connection is cut without a close frame (tornado/websocket.py, _abort)"
NO_AUTH = "nobody has to log in, and there is no op auth in ROS 2"


# --- status ---


@case("status", "SPEC 1.2 status, only after set_level")
def test_status_unasked(client: Client) -> None:
    """Without set_level no status is ever sent, because common clients break on it."""
    client.send("no_such_operation")
    client.send_raw("{not JSON")
    client.send("publish", topic=fresh_name(), msg={})
    client.send("subscribe", topic=fresh_name())
    client.lives()
    client.none("status")


@case("status", "SPEC 1.2 status", suite=NO_STATUS)
def test_status(reported: Client) -> None:
    """A status has a level, a msg for people, and the id of what it is about."""
    reported.send("publish", id="mine", topic=fresh_name(), msg={})
    status = reported.until("status")
    assert status["level"] == "error"
    assert len(status["msg"]) > 10
    assert status["id"] == "mine"


@case("set_level", "SPEC 1.2 set_level", suite=NO_STATUS)
def test_set_level_none(reported: Client) -> None:
    """After set_level none no status comes any more."""
    reported.send("no_such_operation")
    reported.until("status")
    reported.send("set_level", level="none")
    reported.send("no_such_operation")
    reported.lives()
    reported.none("status")


@case("set_level", "SPEC 1.2 set_level", suite=NO_STATUS)
@pytest.mark.parametrize("level", ["info", "warning", "error"])
def test_set_level(client: Client, level: str) -> None:
    """Errors are sent at every level but none."""
    client.send("set_level", level=level)
    client.send("no_such_operation")
    assert client.until("status", level="error")["msg"]


@case("set_level", "SPEC 1.2 set_level", suite=NO_STATUS)
def test_set_level_of_one_client(reported: Client, client: Client) -> None:
    """The level is of one client, not of all."""
    client.send("no_such_operation")
    reported.send("no_such_operation")
    reported.until("status")
    client.none("status")


@case("set_level", ERRORS, suite=NO_STATUS)
def test_set_level_unknown(reported: Client) -> None:
    """A level that doesn't exist is an error in words, and the old one stays."""
    reported.send("set_level", level="shouting")
    assert reported.until("status", level="error")["msg"]


# --- messages ---


@case("any op", ENVELOPE, suite=NO_STATUS)
def test_unknown_op(reported: Client) -> None:
    """An unknown op is answered with an error that names it, and the connection lives."""
    reported.send("make_coffee", id="please")
    assert "make_coffee" in reported.until("status", level="error")["msg"]
    reported.lives()


BAD = {
    "no JSON": "{op: 'publish'}",
    "half of it": '{"op": "publish", "topic": "/x"',
    "two in one": '{"op":"publish","topic":"/x","msg":{}}{"op":"publish","topic":"/x","msg":{}}',
    "an array": '["publish"]',
    "a number": "17",
    "nothing": "",
    "no op": '{"topic": "/x"}',
    "op a number": '{"op": 5}',
    "a field missing": '{"op": "subscribe"}',
    "a field of the wrong type": '{"op": "subscribe", "topic": 5}',
    "a word that is no number": '{"op": "publish", "topic": "/x", "msg": {"data": nan}}',
    "a control character": '{"op": "publish", "topic": "/x\n", "msg": {}}',
}


@case("any op", ERRORS + "; RFC 8259", suite=NO_STATUS)
@pytest.mark.parametrize("what", BAD)
def test_bad_message(reported: Client, what: str) -> None:
    """A message that is not rosbridge is answered with an error and a reason, and the connection lives."""
    reported.send_raw(BAD[what])
    assert reported.until("status", level="error")["msg"]
    reported.lives()


@case("any op", ERRORS, suite=NO_STATUS)
@pytest.mark.parametrize(("op", "missing"), [("call_service", "service"), ("send_action_goal", "action")])
def test_request_without_name(reported: Client, op: str, missing: str) -> None:
    """A call or goal with neither name nor id gets an error that names the missing field, since no answer
    could match it.
    """
    reported.send(op, args={})
    assert missing in reported.until("status", level="error")["msg"]
    reported.lives()


@case("any op", ERRORS)
def test_bad_messages_live(client: Client) -> None:
    """Messages that are not rosbridge have no other effect, also without set_level."""
    for text in BAD.values():
        if "half" not in text:
            client.send_raw(text)
    client.lives()


@case("any op", "SPEC 1, nesting at most 64", suite=NO_STATUS)
@pytest.mark.parametrize("depth", [65, 5000, 200_000])
def test_deep(reported: Client, depth: int) -> None:
    """Nesting beyond 64 is answered with an error in words, and the connection lives."""
    reported.send_raw('{"op":"publish","topic":"/x","msg":{"data":' + "[" * depth + "]" * depth + "}}")
    assert reported.until("status", level="error")["msg"]
    reported.lives()


@case("any op", "SPEC 1, unknown fields")
def test_unknown_fields(client: Client) -> None:
    """Unknown fields are ignored."""
    answer = client.call("/conformance/invert", {"data": False}, favourite_colour="blue", nested={"a": [1]})
    assert answer["result"] is True


@case("any op", "SPEC 1.2, null")
def test_null(client: Client) -> None:
    """A field that is null counts as left out: the call is answered."""
    left_open = {"type": None, "compression": None, "fragment_size": None, "timeout": None}
    answer = client.call("/conformance/invert", {"data": True}, **left_open)
    assert answer["result"] is True


@case("any op", "SPEC 1, numbers within the range", suite=NO_STATUS)
def test_large_number(reported: Client) -> None:
    """A number beyond double and 64 bits is answered with an error in words."""
    reported.send_raw(
        '{"op":"call_service","service":"/conformance/invert","id":"n","args":{"data":' + "9" * 400 + "}}"
    )
    assert reported.until("status", level="error")["msg"]


@case("any op", "SPEC 5, a message from a client; RFC 6455, 7.4.1")
def test_oversized(client: Client) -> None:
    """A message of more than 10 MB (max_message_size of rosbridge_server) closes the connection with 1009."""
    with contextlib.suppress(ConnectionClosed):
        client.send("publish", topic="/x", msg={"data": "x" * 10_000_000})
    assert client.closed() == 1009


@case("any op", "SPEC 5, a message from a client")
def test_just_not_oversized(client: Client) -> None:
    """A message of a little less than 10 MB is taken."""
    answer = client.call("/conformance/invert", {"data": False}, padding="x" * (10_000_000 - 1000))
    assert answer["result"] is True


@case("any op", "SPEC 1.4, 4403", suite=BINARY_IS_TEXT)
def test_binary(client: Client) -> None:
    """A binary message closes the connection with 4403."""
    client.send_raw(json.dumps({"op": "no matter"}).encode())
    assert client.closed() == 4403


@case("status", "SPEC 1.4-2", suite=NO_STATUS)
@pytest.mark.parametrize(
    ("sent", "code"), [(b"{}", 4403), ("x" * 10_000_001, 1009)], ids=["binary", "oversized"]
)
def test_status_before_a_close(reported: Client, sent: str | bytes, code: int) -> None:
    """Before the close frame a status has the reason."""
    with contextlib.suppress(ConnectionClosed):
        reported.send_raw(sent)
    status = reported.until("status", id="closed")
    assert status["level"] == "error"
    assert len(status["msg"]) > 10
    assert reported.closed() == code


@case("any op", "RFC 6455, 8.1", suite=NO_1007)
@pytest.mark.parametrize(
    "text", [b'{"op":"\xff"}', [b'{"op":"\xe2', b'\x28"}']], ids=["one frame", "fragments"]
)
def test_not_utf8(client: Client, text: bytes | list[bytes]) -> None:
    """Text that is not UTF-8 closes the connection with 1007."""
    with contextlib.suppress(ConnectionClosed):
        # The server may close before the last fragment is sent.
        client.connection.send(text, text=True)
    assert client.closed() == 1007


@case("any op", "SPEC 1.3, 100 messages in a row; 1.4, 4429")
def test_too_many_errors(client: Client) -> None:
    """A hundred messages in a row that are no rosbridge close the connection with 4429."""
    with contextlib.suppress(ConnectionClosed):
        for _ in range(100):
            client.send_raw("gibberish")
    assert client.closed() == 4429


@case("any op", "RFC 6455, 5.4")
def test_websocket_fragments(client: Client) -> None:
    """A text message in several websocket frames is one message."""
    text = json.dumps(
        {"op": "call_service", "id": "w", "service": "/conformance/invert", "args": {"data": False}}
    )
    client.connection.send([text[:20], text[20:21], text[21:]])
    assert client.until("service_response", id="w")["result"] is True


@case("any op", "RFC 6455, 5.5.2 Ping")
def test_ping(client: Client) -> None:
    """A websocket ping is answered."""
    assert client.connection.ping(b"are you there").wait(client.patience)


# --- credentials ---


def closes_or_refuses(url: str, token: str = "", **options: Any) -> int:
    """The HTTP status of a refused handshake, or the close code after one."""
    try:
        with Client(url, token, **options) as connected:
            return connected.closed()
    except InvalidStatus as refused:
        return refused.response.status_code


@case("auth", "SPEC 1.1, access token in mac", suite=NO_AUTH)
def test_auth(server: Server) -> None:
    """A client without credentials in the handshake logs in by auth, the token in mac."""
    server.needs_token()
    rosauth = {"client": "me", "dest": "you", "rand": "r", "t": 1, "level": "admin", "end": 2}
    with Client(server.url) as client:
        client.send("auth", mac=server.token, **rosauth)
        client.lives()


@case("auth", "SPEC 1.1; rosauth on every connection")
def test_auth_again(client: Client, server: Server) -> None:
    """auth on a connection that is logged in already has no effect."""
    client.send("auth", mac=server.token or "x")
    client.lives()


@case("auth", "SPEC 1.4, 4401", suite=NO_AUTH)
def test_auth_wrong(server: Server) -> None:
    """A wrong token in auth closes the connection with 4401."""
    server.needs_token()
    with Client(server.url) as client:
        client.send("auth", mac="wrong" + server.token)
        assert client.closed() == 4401


@case("auth", "SPEC 1.1, the first message", suite=NO_AUTH)
def test_no_operation_before_auth(server: Server) -> None:
    """Before auth no operation is executed: the call is not answered, the connection closed with 4401."""
    server.needs_token()
    with Client(server.url) as client:
        client.send("call_service", id="early", service="/conformance/invert", args={"data": True})
        assert client.closed() == 4401


@case("auth", "SPEC 1.1, Authorization", suite=NO_AUTH)
def test_bearer_wrong(server: Server) -> None:
    """A wrong token in the Authorization header is refused with HTTP 401."""
    server.needs_token()
    assert closes_or_refuses(server.url, "wrong" + server.token) == 401


@case("auth", "SPEC 1.1, subprotocol", suite=NO_AUTH)
def test_subprotocol(server: Server) -> None:
    """The token may come as subprotocol bearer.<token>, which the answer selects."""
    server.needs_token()
    name = f"bearer.{server.token}"
    with Client(server.url, subprotocols=[name]) as client:
        assert client.connection.subprotocol == name
        client.lives()


@case("auth", "SPEC 1.1, the same answer", suite=NO_AUTH)
def test_no_such_robot(server: Server) -> None:
    """A robot that does not exist is refused, by a close code or a status without further information."""
    server.needs_token()
    nobody = server.url.rpartition("/")[0] + "/no-such-robot"
    assert closes_or_refuses(nobody, server.token) in (403, 404, 4403, 4404)


@case("auth", "SPEC 1.1, ticket", suite=NO_AUTH)
def test_ticket(server: Server) -> None:
    """A ticket in the URL opens one connection, and no second."""
    server.needs_token()
    base, _, robot = server.http_url.rpartition("/robots/")
    headers = {"Authorization": f"Bearer {server.token}", "Content-Type": "application/json"}
    body = json.dumps({"robot": robot}).encode()
    with urllib.request.urlopen(urllib.request.Request(f"{base}/api/v1/tickets", body, headers)) as answer:
        ticket = json.load(answer)["ticket"]
    with Client(f"{server.url}?ticket={ticket}") as client:
        client.lives()
    assert closes_or_refuses(f"{server.url}?ticket={ticket}") in (401, 4401)


# --- the address ---


@case("HTTP GET", "SPEC 1; protocol and version as JSON")
def test_http_get(server: Server) -> None:
    """A plain GET on the same address answers with version and protocol as JSON."""
    headers = {"Authorization": f"Bearer {server.token}"} if server.token else {}
    with urllib.request.urlopen(
        urllib.request.Request(server.http_url, headers=headers), timeout=8
    ) as answer:
        assert answer.status == 200
        assert answer.headers.get_content_type() == "application/json"
        about = json.load(answer)
    assert about["protocol"]
    assert about.get("version") or about.get("server")


@case("any op", "SPEC 1, one websocket is one client")
def test_many_clients(server: Server) -> None:
    """Ten clients at once are served, and none gets another's messages."""
    clients = [server.connect() for _ in range(10)]
    try:
        for number, each in enumerate(clients):
            args = {"data": number % 2 == 0}
            each.send("call_service", id=number, service="/conformance/invert", args=args)
        for number, each in enumerate(clients):
            answer = each.until("service_response")
            assert (answer["id"], answer["values"]["success"]) == (number, number % 2 == 1)
            each.none("service_response", ABSENCE / 10)
    finally:
        for each in clients:
            each.close()
