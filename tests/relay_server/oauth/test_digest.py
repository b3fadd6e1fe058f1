"""Digest authentication, answered by httpx."""

from __future__ import annotations

import re

import httpx
import pytest

from relay_server.access import BadCredentials
from relay_server.auth import passwords
from relay_server.oauth import digest as module
from relay_server.oauth.digest import NONCE_SECONDS, Digest, StaleNonce

KEY, SECRET = "swp_1", "swb_secret"
KNOWN = passwords.verifier(KEY, SECRET)
URL = "http://relay/oauth/token?x=1"
URI = "/oauth/token?x=1"


class Clock:
    """Seconds that pass when the test says so."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Client:
    """A program that answers challenges as httpx does."""

    def __init__(self, secret: str = SECRET) -> None:
        self._auth = httpx.DigestAuth(KEY, secret)

    def answer(self, challenge: str, method: str = "POST") -> str:
        """What it sends after it got this challenge."""
        flow = self._auth.auth_flow(httpx.Request(method, URL))
        first = next(flow)
        if "authorization" not in first.headers:
            headers = {"www-authenticate": challenge}
            first = flow.send(httpx.Response(401, headers=headers, request=first))
        return str(first.headers["authorization"])

    def again(self) -> str:
        """What it sends with its next request, to the challenge that it has."""
        return self.answer("")


@pytest.fixture
def clock() -> Clock:
    """Time."""
    return Clock()


@pytest.fixture
def digest(clock: Clock) -> Digest:
    """Who asks."""
    return Digest(clock)


def test_who_has_the_secret_is_believed(digest: Digest) -> None:
    """Once, and again with the next count."""
    client = Client()
    proof = digest.read(client.answer(digest.challenge()))
    assert proof.key == KEY
    digest.check(proof, KNOWN, "POST", URI)
    digest.check(digest.read(client.again()), KNOWN, "POST", URI)


def test_a_challenge_names_what_is_asked_for(digest: Digest) -> None:
    """SHA-256, counted; no MD5."""
    said = digest.challenge()
    assert 'realm="switchboard"' in said and "algorithm=SHA-256" in said and 'qop="auth"' in said
    assert "stale" not in said
    assert digest.challenge(stale=True).endswith("stale=true")


@pytest.mark.parametrize(
    ("secret", "method", "uri"),
    [("other", "POST", URI), (SECRET, "GET", URI), (SECRET, "POST", "/oauth/revoke")],
)
def test_who_has_not_or_asks_for_something_else_is_not(
    digest: Digest, secret: str, method: str, uri: str
) -> None:
    """An answer is for one method and one address."""
    proof = digest.read(Client(secret).answer(digest.challenge()))
    with pytest.raises(BadCredentials, match="secret is wrong") as caught:
        digest.check(proof, KNOWN, method, uri)
    assert not isinstance(caught.value, StaleNonce)


def test_an_answer_counts_once(digest: Digest) -> None:
    """Who has listened can't send it again."""
    header = Client().answer(digest.challenge())
    digest.check(digest.read(header), KNOWN, "POST", URI)
    with pytest.raises(StaleNonce, match="given before"):
        digest.check(digest.read(header), KNOWN, "POST", URI)


def test_an_old_challenge_is_replaced(digest: Digest, clock: Clock) -> None:
    """The answer is right, and comes too late."""
    client = Client()
    header = client.answer(digest.challenge())
    clock.now += NONCE_SECONDS + 1
    with pytest.raises(StaleNonce, match="too old"):
        digest.check(digest.read(header), KNOWN, "POST", URI)


def test_a_challenge_of_somebody_else_is_worth_nothing(digest: Digest, clock: Clock) -> None:
    """One of before a restart, or one that somebody made up."""
    header = Client().answer(Digest(clock).challenge())
    with pytest.raises(StaleNonce):
        digest.check(digest.read(header), KNOWN, "POST", URI)


def test_memory_is_bounded(digest: Digest, monkeypatch: pytest.MonkeyPatch) -> None:
    """When too many challenges are in use all are given out anew, so that no answer counts twice."""
    monkeypatch.setattr(module, "NONCES", 2)
    client = Client()
    headers = [Client().answer(digest.challenge()) for _ in range(2)]
    headers.append(client.answer(digest.challenge()))
    for header in headers:
        digest.check(digest.read(header), KNOWN, "POST", URI)
    for header in headers:
        with pytest.raises(StaleNonce):
            digest.check(digest.read(header), KNOWN, "POST", URI)
    digest.check(digest.read(Client().answer(digest.challenge())), KNOWN, "POST", URI)


@pytest.mark.parametrize(
    "change",
    [
        lambda header: "Digest",
        lambda header: "Digest x",
        lambda header: "Digest " + "x" * 5000,
        lambda header: 'Digest username="\x00"',
        lambda header: header.replace("SHA-256", "MD5"),
        lambda header: header.replace("qop=auth", "qop=auth-int"),
        lambda header: header.replace('realm="switchboard"', 'realm="other"'),
        lambda header: re.sub(r"nc=\w+, ", "", header),
        lambda header: re.sub(r"nc=\w+", "nc=zz", header),
        lambda header: re.sub(r'response="\w+"', 'response="ä"', header),
        lambda header: re.sub(r'nonce="[^"]+"', 'nonce="..x"', header),
        lambda header: re.sub(r'nonce="[^"]+"', 'nonce="\ud800"', header),
    ],
)
def test_what_is_no_answer_is_refused_in_words(digest: Digest, change: object) -> None:
    """Whatever the header says, nothing breaks."""
    header = change(Client().answer(digest.challenge()))  # type: ignore[operator]
    with pytest.raises(BadCredentials):
        digest.check(digest.read(header), KNOWN, "POST", URI)
