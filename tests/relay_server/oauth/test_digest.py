"""Digest authentication, answered by httpx."""

from __future__ import annotations

import re

import httpx
import pytest

from relay_server.access import BadCredentials
from relay_server.auth import passwords
from relay_server.oauth import digest as module
from relay_server.oauth.digest import NONCE_SECONDS, Digest, StaleNonce, WrongAddress

KEY, SECRET = "swc_1", "swb_secret"
KNOWN = passwords.digest_ha1(KEY, SECRET)
URL = "http://relay/oauth/token?x=1"
URI = "/oauth/token?x=1"


class Clock:
    """A clock of the test."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Client:
    """An OAuth client that answers challenges as httpx does."""

    def __init__(self, secret: str = SECRET) -> None:
        self._auth = httpx.DigestAuth(KEY, secret)

    def answer(self, challenge: str, method: str = "POST") -> str:
        """Its answer to this challenge."""
        flow = self._auth.auth_flow(httpx.Request(method, URL))
        first = next(flow)
        if "authorization" not in first.headers:
            headers = {"www-authenticate": challenge}
            first = flow.send(httpx.Response(401, headers=headers, request=first))
        return str(first.headers["authorization"])

    def again(self) -> str:
        """Its next request, with the challenge that it has."""
        return self.answer("")


@pytest.fixture
def clock() -> Clock:
    """A clock."""
    return Clock()


@pytest.fixture
def digest(clock: Clock) -> Digest:
    """Digest authentication on the clock."""
    return Digest(clock)


def test_the_right_secret_is_accepted(digest: Digest) -> None:
    """Once, and again with the next count."""
    client = Client()
    proof = digest.read(client.answer(digest.challenge()))
    assert proof.key == KEY
    digest.check(proof, KNOWN, "POST", URI)
    digest.check(digest.read(client.again()), KNOWN, "POST", URI)


def test_a_challenge_names_its_parameters(digest: Digest) -> None:
    """SHA-256 with a count, and no MD5."""
    said = digest.challenge()
    assert 'realm="switchboard"' in said and "algorithm=SHA-256" in said and 'qop="auth"' in said
    assert "stale" not in said
    assert digest.challenge(stale=True).endswith("stale=true")


@pytest.mark.parametrize(
    ("secret", "method", "uri"),
    [("other", "POST", URI), ("other", "POST", "/oauth/revoke"), (SECRET, "GET", URI)],
)
def test_a_wrong_secret_or_method_is_refused(digest: Digest, secret: str, method: str, uri: str) -> None:
    proof = digest.read(Client(secret).answer(digest.challenge()))
    with pytest.raises(BadCredentials, match="secret is wrong") as caught:
        digest.check(proof, KNOWN, method, uri)
    assert caught.value.code == BadCredentials.code


def test_an_answer_for_another_address_is_refused_with_both(digest: Digest) -> None:
    proof = digest.read(Client().answer(digest.challenge()))
    with pytest.raises(WrongAddress, match=r"'/oauth/token\?x=1', but the request came to '/token'"):
        digest.check(proof, KNOWN, "POST", "/token")
    digest.check(proof, KNOWN, "POST", URI)  # it is not used up


def test_an_answer_counts_once(digest: Digest) -> None:
    header = Client().answer(digest.challenge())
    digest.check(digest.read(header), KNOWN, "POST", URI)
    with pytest.raises(StaleNonce, match="used before"):
        digest.check(digest.read(header), KNOWN, "POST", URI)


def test_an_old_challenge_is_replaced(digest: Digest, clock: Clock) -> None:
    """The answer is right but too late."""
    client = Client()
    header = client.answer(digest.challenge())
    clock.now += NONCE_SECONDS + 1
    with pytest.raises(StaleNonce, match="too old"):
        digest.check(digest.read(header), KNOWN, "POST", URI)


def test_a_foreign_challenge_is_refused(digest: Digest, clock: Clock) -> None:
    header = Client().answer(Digest(clock).challenge())
    with pytest.raises(StaleNonce):
        digest.check(digest.read(header), KNOWN, "POST", URI)


def test_memory_is_bounded(digest: Digest, monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_an_invalid_response_is_refused(digest: Digest, change: object) -> None:
    """For any content of the header."""
    header = change(Client().answer(digest.challenge()))  # type: ignore[operator]
    with pytest.raises(BadCredentials):
        digest.check(digest.read(header), KNOWN, "POST", URI)
