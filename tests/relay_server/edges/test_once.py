"""Requests that are sent again with their key."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import pytest
from twisted.internet.task import Clock
from twisted.web.test.requesthelper import DummyRequest

from relay_protocol.errors import Invalid, Refused
from relay_protocol.rights import Operation
from relay_server.http.idempotency import KEY_HEADER, Idempotency, StoredReply
from relay_server.http.idempotent_requests import IdempotentRequests, see_no_key, send
from relay_server.resources.service import RequestOrigin
from tests.relay_server.edges.http_client import ANN
from tests.relay_server.steering import outcome, result

ASKER = RequestOrigin(ANN, "rover", "192.0.2.9")


class Desk:
    """Lets people do what they ask, until it does not."""

    withdrawn = False

    async def may(self, asker: RequestOrigin, operation: Operation, name: str) -> None:
        """As it says."""
        if self.withdrawn:
            raise Refused(f"no more {operation} on {name}")


class Requests:
    """Requests, and how often something was done for them."""

    def __init__(self) -> None:
        self.desk = Desk()
        self.done = 0
        self._once = IdempotentRequests(Idempotency(Clock()), self.desk)  # type: ignore[arg-type]

    def send(self, *keys: str, name: str = "reset", body: bytes = b"{}") -> Any:
        """A request with these keys."""
        request: Any = DummyRequest([name.encode()])
        request.path = b"/" + name.encode()
        request.content = BytesIO(body)
        request.content.read()
        request.requestHeaders.setRawHeaders(KEY_HEADER, keys)
        return self._once.reply(request, ASKER, Operation.CALL, name, self._work)

    async def _work(self) -> StoredReply:
        self.done += 1
        return StoredReply(200, b"%d" % self.done)


@pytest.fixture
def requests() -> Requests:
    """None yet."""
    return Requests()


def test_what_is_sent_again_is_done_once(requests: Requests) -> None:
    """With a key; where there is none it is done each time."""
    assert [result(requests.send("k")).body for _ in "ab"] == [b"1", b"1"]
    assert [result(requests.send()).body for _ in "ab"] == [b"2", b"3"]
    assert result(requests.send("k", name="other")).body == b"4"


def test_a_stop_is_done_each_time(requests: Requests) -> None:
    """Whatever its key: nobody must find a robot going on because he has stopped it before."""
    for keys in (("k",), ("k",), ("k" * 1000,), ("a", "b")):
        for name in ("relay/stop", "/relay/release_control"):
            result(requests.send(*keys, name=name))
    assert requests.done == 8


def test_a_key_that_makes_no_sense_is_refused(requests: Requests) -> None:
    """And nothing is done."""
    for keys in (("k" * 256,), ("a", "b"), ("",)):
        (error,) = outcome(requests.send(*keys))
        assert isinstance(error, Invalid)
    assert requests.done == 0


def test_who_may_not_any_more_is_not_answered_again(requests: Requests) -> None:
    """By what he was answered when he might."""
    result(requests.send("k"))
    requests.desk.withdrawn = True
    (error,) = outcome(requests.send("k"))
    assert str(error) == "no more call on reset"


def test_where_a_key_is_not_understood_it_is_refused() -> None:
    """In words: who sends one relies on it."""
    request: Any = DummyRequest([b""])
    see_no_key(request)
    request.requestHeaders.setRawHeaders(KEY_HEADER, ["k"])
    with pytest.raises(Invalid, match="is not understood at this address"):
        see_no_key(request)


@pytest.mark.parametrize(
    ("reply", "location"), [(StoredReply(204), None), (StoredReply(202, b"{}", "/there"), ["/there"])]
)
def test_a_reply_is_sent_as_it_is(reply: StoredReply, location: list[str] | None) -> None:
    """Status, body and where to go on."""
    request: Any = DummyRequest([b""])
    body = send(request, reply)
    assert (request.responseCode, b"" if body is None else bytes(body)) == (reply.status, reply.body)
    assert request.responseHeaders.getRawHeaders("location") == location
