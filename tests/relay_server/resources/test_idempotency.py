"""A request with an idempotency key is carried out once; repetitions get the same answer."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol.errors import Invalid, Refused, Unavailable
from relay_server.common.errors import NotDone
from relay_server.http import idempotency as module
from relay_server.http.idempotency import Idempotency, KeyReused, StoredReply, Target, key_in
from relay_server.in_process_sessions.in_process_port import MaybeDone
from relay_server.resources.goals import GoalOwner
from tests.worlds.control import outcome, result

ANN = GoalOwner(1, "default", None)
DONE = StoredReply(200, b'"done"')


class Requests:
    """Requests of users, and the work done for them."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.memory = Idempotency(self.clock)
        self.work: list[Deferred[StoredReply]] = []
        self.withdrawn = False

    def send(self, key: str = "k", body: bytes = b"{}", owner: GoalOwner = ANN, **target: str) -> list[Any]:
        """Sends a request; the list gets its answer or error."""
        return outcome(self.request(key, body, owner, **target))

    def request(
        self,
        key: str = "k",
        body: bytes = b"{}",
        owner: GoalOwner = ANN,
        robot: str = "rover",
        address: str = "/a",
    ) -> Deferred[StoredReply]:
        """Sends a request that the test may cancel."""
        target = Target(owner, robot, address, key)
        return Deferred.fromCoroutine(self.memory.once(target, body, self._do, self._may))

    async def _do(self) -> StoredReply:
        self.work.append(Deferred())
        return await self.work[-1]

    async def _may(self) -> None:
        if self.withdrawn:
            raise Refused("no more")


@pytest.fixture
def requests() -> Requests:
    """No requests yet."""
    return Requests()


def test_the_first_answer_is_given_again(requests: Requests) -> None:
    """This includes repetitions that arrive before the first answer."""
    first, second = requests.send(), requests.send()
    assert (first, second) == ([], [])
    (work,) = requests.work
    work.callback(DONE)
    assert first == second == requests.send() == [DONE]
    assert len(requests.work) == 1


@pytest.mark.parametrize(
    "other",
    [
        {"key": "l"},
        {"owner": GoalOwner(2, "default", None)},
        {"owner": GoalOwner(1, "default", "viewer")},
        {"robot": "other"},
        {"address": "/b"},
    ],
)
def test_a_key_means_nothing_elsewhere(requests: Requests, other: dict[str, Any]) -> None:
    """Other users, scopes, robots and addresses have their own keys."""
    requests.send()
    requests.send(**other)
    assert len(requests.work) == 2


def test_another_body_is_another_request(requests: Requests) -> None:
    """It needs a key of its own, also while the first request is active."""
    requests.send()
    (error,) = requests.send(body=b"[]")
    assert isinstance(error, KeyReused)


def test_started_order_completes_without_its_sender(requests: Requests) -> None:
    """The sender gets the answer by repeating the request."""
    left = requests.request()
    left.addErrback(lambda failure: None)
    left.cancel()
    requests.work[0].callback(DONE)
    assert requests.send() == [DONE]


@pytest.mark.parametrize(
    ("error", "kept"),
    [
        (NotDone("no"), True),
        (MaybeDone(Refused("your right was revoked")), True),
        (RuntimeError("broken"), True),
        (Unavailable("no"), False),
    ],
)
def test_errors_are_given_again_unless_nothing_was_done(
    requests: Requests, error: Exception, kept: bool
) -> None:
    """If nothing was done, the request is tried again."""
    first, second = requests.send(), requests.send()
    requests.work[0].errback(error)
    assert first == second == [error]
    third = requests.send()
    assert third == ([error] if kept else [])
    assert len(requests.work) == (1 if kept else 2)


def test_a_stored_answer_needs_the_current_right(requests: Requests) -> None:
    """The right may be revoked by then."""
    requests.send()
    requests.work[0].callback(DONE)
    requests.withdrawn = True
    (error,) = requests.send()
    assert isinstance(error, Refused)


def test_an_answer_is_stored_for_ten_minutes(requests: Requests) -> None:
    """From the time of the answer; then no state is left."""
    requests.send()
    requests.clock.advance(module.KEPT_SECONDS)
    requests.work[0].callback(DONE)
    requests.clock.advance(module.KEPT_SECONDS - 1)
    assert requests.send() == [DONE]
    requests.clock.advance(1)
    assert not requests.memory._of
    assert requests.send() == []


def test_stored_answers_are_limited(requests: Requests, monkeypatch: pytest.MonkeyPatch) -> None:
    """Per user, by number and by size: the oldest answers are removed; the newest and active requests stay."""
    monkeypatch.setattr(module, "KEYS", 3)
    monkeypatch.setattr(module, "ANSWERS_BYTES", 100)
    for key, size in (("a", 10), ("b", 10), ("c", 10), ("d", 10)):
        requests.send(key)
        requests.work[-1].callback(StoredReply(200, b"x" * size))
    assert (len(requests.send("b")), len(requests.send("a"))) == (1, 0)
    requests.send("e")
    requests.work[-1].callback(StoredReply(200, b"x" * 1000))
    assert len(requests.send("e")) == 1
    assert [len(requests.send(key)) for key in "d"] == [0]
    requests.work[4].callback(DONE)
    assert requests.send("a") == [DONE]


def test_active_requests_are_limited(requests: Requests, monkeypatch: pytest.MonkeyPatch) -> None:
    """Per user."""
    monkeypatch.setattr(module, "KEYS", 2)
    requests.send("a"), requests.send("b")
    (error,) = requests.send("c")
    assert isinstance(error, Unavailable)
    assert requests.send("c", owner=GoalOwner(2, "default", None)) == []
    requests.work[0].callback(DONE)
    assert requests.send("c") == []


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ([], None),
        (['"8e03978e"'], "8e03978e"),
        ([" 8e03978e "], "8e03978e"),
        ([r'"a \"b\" \\ c"'], r'a "b" \ c'),
        (["k" * 255], "k" * 255),
    ],
)
def test_keys_are_read_with_and_without_quotes(values: list[str], key: str | None) -> None:
    """The draft requires quotes; some programs leave them out."""
    assert key_in(values) == key


@pytest.mark.parametrize("values", [[""], ['""'], ['"open'], ["a b"], ["ä"], ["k" * 256], ["a", "b"]])
def test_a_key_that_makes_no_sense_is_refused(values: list[str]) -> None:
    """With a reason."""
    with pytest.raises(Invalid, match="idempotency-key"):
        key_in(values)


def test_an_answer_at_once_is_an_answer(requests: Requests) -> None:
    """Work without waiting is done within the request."""

    async def work() -> StoredReply:
        return DONE

    target = Target(ANN, "rover", "/a", "k")
    assert result(requests.memory.once(target, b"", work, requests._may)) == DONE
