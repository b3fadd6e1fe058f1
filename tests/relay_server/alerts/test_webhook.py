"""Messages reach who is meant, signed, and nobody within networks that are not allowed."""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet.task import deferLater

from relay_protocol.errors import Invalid
from relay_server.alerts import webhook as module
from relay_server.alerts.egress import EgressPolicy, NameResolver, parse_networks
from relay_server.alerts.message import Undelivered
from relay_server.alerts.webhook import ANSWER_BYTES, Webhooks, parse, signature
from tests.relay_server.alerts.made_up import SECRET, message, rule
from tests.relay_server.alerts.receiver import REACTOR, Hook, certificate, raw, serve

LOOPBACK = parse_networks(["127.0.0.0/8", "::1/128"])


class Resolver:
    """Answers as the test says, a list at a time, the last one for ever."""

    def __init__(self, *answers: list[str]) -> None:
        self.answers = list(answers)
        self.asked: list[tuple[str, int]] = []

    async def __call__(self, host: str, port: int, user: int) -> list[str]:
        self.asked.append((host, port))
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]


class Scene:
    """Receivers, and who sends to them."""

    def __init__(self) -> None:
        self.ports: list[Any] = []

    def open(self, port: Any) -> int:
        """Listen until the end; the number of the port."""
        self.ports.append(port)
        return int(port.getHost().port)

    async def close(self) -> None:
        """Listen no more."""
        for each in self.ports:
            await each.stopListening()


def sender(resolver: Any = None, allowed: Any = LOOPBACK, trust: Any = None) -> Webhooks:
    """Sends to this machine alone, unless told otherwise."""
    fence = EgressPolicy(frozenset, allowed)
    made = Webhooks(REACTOR, resolver or Resolver(["127.0.0.1"]), fence, lambda: 1700000000.9, trust)
    made.relay = "relay-1"
    return made


@pytest_twisted.async_yield_fixture
async def scene() -> AsyncIterator[Scene]:
    """Nobody listens yet."""
    made = Scene()
    yield made
    await made.close()


async def refused(webhooks: Webhooks, url: str) -> Undelivered:
    """Why it does not arrive."""
    with pytest.raises(Undelivered) as error:
        await webhooks.send(rule(url=url), message())
    return error.value


@pytest_twisted.ensureDeferred
async def test_a_receiver_can_tell_who_sent_what_when(scene: Scene) -> None:
    """The body is as the contract says, and the signature is over its bytes and the time."""
    hook = Hook()
    port = scene.open(serve(hook))
    await sender().send(rule(url=f"http://hooks.example:{port}/a/b?c=d"), message(left_out=3))
    ((request, body),) = hook.got
    assert (request.method, request.uri) == (b"POST", b"/a/b?c=d")
    assert request.getHeader("host") == f"hooks.example:{port}"
    assert request.getHeader("content-type") == "application/json"
    assert request.getHeader("switchboard-delivery") == "d1"
    assert request.getHeader("switchboard-timestamp") == "1700000000"
    expected = hmac.new(SECRET.encode(), b"1700000000." + body, hashlib.sha256).hexdigest()
    assert request.getHeader("switchboard-signature") == f"v1={expected}"
    assert signature(SECRET, "1700000000", body) == f"v1={expected}"
    told = json.loads(body)
    assert {each: told[each] for each in ("relay", "delivery", "rule", "left_out")} == {
        "relay": "relay-1",
        "delivery": "d1",
        "rule": 7,
        "left_out": 3,
    }
    (alert,) = told["alerts"]
    assert alert["event"] == "begun"
    assert (alert["robot"], alert["kind"], alert["state"], alert["acknowledged"]) == (
        "rover",
        "offline",
        "open",
        None,
    )
    assert SECRET not in body.decode()


@pytest_twisted.ensureDeferred
async def test_the_connection_goes_to_the_address_that_was_judged(scene: Scene) -> None:
    """A name that stands for something else a moment later is asked for once a try, and judged each time."""
    hook = Hook()
    port = scene.open(serve(hook))
    url = f"http://rebound.example:{port}/"
    resolver = Resolver(["127.0.0.1"], ["10.0.0.7"], ["::ffff:169.254.169.254"])
    webhooks = sender(resolver)
    await webhooks.send(rule(url=url), message())
    assert (len(hook.got), len(resolver.asked)) == (1, 1)
    for _ in range(2):
        assert "does not send to" in str(await refused(webhooks, url))
    assert len(hook.got) == 1


@pytest_twisted.ensureDeferred
async def test_a_name_within_is_told_like_one_that_nobody_knows() -> None:
    """In the same words, and it is tried as often: else users could ask for the names of the relay's networks."""
    names = NameResolver(REACTOR)
    names.start()
    try:
        unknown = await refused(sender(names.addresses, ()), "http://no-such-host.invalid/")
    finally:
        names.stop()
    within = await refused(sender(Resolver(["10.0.0.7"]), ()), "http://no-such-host.invalid/")
    assert (str(within), within.again) == (str(unknown), unknown.again)
    plain = await refused(sender(Resolver(["10.0.0.7"]), ()), "http://10.0.0.7/")
    assert ("administrator" in str(plain), plain.again) == (True, False)


@pytest_twisted.ensureDeferred
async def test_of_several_addresses_only_the_allowed_are_tried(scene: Scene) -> None:
    """Also when the others come first."""
    hook = Hook()
    port = scene.open(serve(hook, "127.0.0.2"))
    resolver = Resolver(["127.0.0.1", "10.0.0.7", "127.0.0.2"])
    await sender(resolver, parse_networks(["127.0.0.2/32"])).send(
        rule(url=f"http://x.example:{port}/"), message()
    )
    assert len(hook.got) == 1


@pytest_twisted.ensureDeferred
async def test_an_address_where_nobody_answers_gives_way_to_the_next(scene: Scene) -> None:
    """As browsers do."""
    hook = Hook()
    port = scene.open(serve(hook, "127.0.0.2"))
    resolver = Resolver(["127.0.0.1", "127.0.0.2"])
    await sender(resolver).send(rule(url=f"http://x.example:{port}/"), message())
    assert len(hook.got) == 1


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1",
        "2130706433",
        "0x7f000001",
        "0177.0.0.1",
        "127.1",
        "localhost",
        "[::1]",
        "[::ffff:127.0.0.1]",
        "0",
    ],
)
@pytest_twisted.ensureDeferred
async def test_this_machine_is_not_reached_under_any_of_its_names(scene: Scene, host: str) -> None:
    """The system resolves them all, and what comes of it is judged."""
    hook = Hook()
    port = scene.open(serve(hook))
    names = NameResolver(REACTOR)
    names.start()
    try:
        error = await refused(sender(names.addresses, ()), f"http://{host}:{port}/")
    finally:
        names.stop()
    assert "does not send to" in str(error)
    assert hook.got == []


@pytest_twisted.ensureDeferred
async def test_a_redirect_is_not_followed(scene: Scene) -> None:
    """It may lead anywhere."""
    inside, hook = Hook(), Hook(302)
    hook.headers = {"location": f"http://127.0.0.1:{scene.open(serve(inside))}/"}
    error = await refused(sender(), f"http://x.example:{scene.open(serve(hook))}/")
    assert (str(error), error.again) == ("x.example answered with the status 302", False)
    assert (len(hook.got), inside.got) == (1, [])


@pytest.mark.parametrize(
    ("status", "again"),
    [(400, False), (404, False), (408, True), (410, False), (429, True), (500, True), (503, True)],
)
@pytest_twisted.ensureDeferred
async def test_what_may_pass_is_worth_another_try(scene: Scene, status: int, again: bool) -> None:
    """A receiver that says no for good is not asked again."""
    error = await refused(sender(), f"http://x.example:{scene.open(serve(Hook(status)))}/")
    assert error.again is again


@pytest_twisted.ensureDeferred
async def test_a_receiver_that_never_answers_is_given_up(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And its connection ends."""
    monkeypatch.setattr(module, "SECONDS", 0.3)
    hook = Hook(0)
    error = await refused(sender(), f"http://x.example:{scene.open(serve(hook))}/")
    assert error.again
    assert "did not answer" in str(error)
    ((request, _),) = hook.got
    while not request._disconnected:
        await deferLater(REACTOR, 0.01)


@pytest_twisted.ensureDeferred
async def test_an_endless_answer_is_cut(scene: Scene) -> None:
    """Headers without end, or lines: no more is read than a little."""
    sent = [0]

    def flood(transport: Any) -> None:
        sent[0] += 1
        transport.write(b"HTTP/1.1 200 OK\r\n" + b"X-Y: " + b"z" * 8000 + b"\r\n")
        for _ in range(2 * ANSWER_BYTES // 8000):
            transport.write(b"X-Y: " + b"z" * 8000 + b"\r\n")

    error = await refused(sender(), f"http://x.example:{scene.open(raw(flood))}/")
    assert (str(error), error.again) == ("x.example hung up before it answered", True)


@pytest.mark.parametrize("says", [b"", b"SSH-2.0-OpenSSH_9.2\r\n", b"\x00" * 1000])
@pytest_twisted.ensureDeferred
async def test_what_speaks_no_http_is_told_in_words(scene: Scene, says: bytes) -> None:
    """Nothing of what it says is passed on to the user."""

    def behave(transport: Any) -> None:
        transport.write(says)
        transport.loseConnection()

    error = await refused(sender(), f"http://x.example:{scene.open(raw(behave))}/")
    assert str(error) == "x.example hung up before it answered"


@pytest_twisted.ensureDeferred
async def test_nobody_there_is_told_in_words(scene: Scene) -> None:
    """It is worth another try."""
    port = serve(Hook())
    number = port.getHost().port
    await port.stopListening()
    error = await refused(sender(), f"http://x.example:{number}/")
    assert (str(error), error.again) == (f"nobody answers at x.example, port {number}", True)


@pytest_twisted.ensureDeferred
async def test_tls_is_checked_by_name_and_signer(scene: Scene, tmp_path: Path) -> None:
    """A certificate of another name, or one nobody trusts, gets nothing."""
    hook = Hook()
    options, trusted = certificate(tmp_path, "good.example")
    port = scene.open(serve(hook, tls=options))
    await sender(trust=trusted).send(rule(url=f"https://good.example:{port}/"), message())
    assert len(hook.got) == 1
    for host, trust in (("other.example", trusted), ("good.example", None)):
        error = await refused(sender(trust=trust), f"https://{host}:{port}/")
        assert "no certificate" in str(error)
    plain = scene.open(raw(lambda transport: transport.write(b"HTTP/1.1 400 Bad Request\r\n\r\n")))
    assert "speaks no TLS" in str(await refused(sender(), f"https://good.example:{plain}/"))
    assert len(hook.got) == 1


@pytest_twisted.ensureDeferred
async def test_a_name_that_nobody_knows_is_told_in_words() -> None:
    """No name server can make the relay fail."""
    names = NameResolver(REACTOR)
    names.start()
    try:
        for host in ("no-such-host.invalid", "a" * 64 + ".example", ".".join(["abc"] * 60)):
            error = await refused(sender(names.addresses), f"http://{host}/")
            assert "nobody knows an address" in str(error)
    finally:
        names.stop()


@pytest.mark.parametrize(
    ("url", "place"),
    [
        ("https://example.org", (True, "example.org", 443, "/")),
        ("http://example.org:8080/a/b?c=d&e=%0a", (False, "example.org", 8080, "/a/b?c=d&e=%0a")),
        ("HTTPS://Example.ORG./x", (True, "example.org.", 443, "/x")),
        ("https://[2001:DB8::1]:8443/x", (True, "2001:db8::1", 8443, "/x")),
        ("http://192.0.2.1?x", (False, "192.0.2.1", 80, "/?x")),
    ],
)
def test_addresses_of_webhooks_are_read_in_one_way(url: str, place: tuple[object, ...]) -> None:
    """And put together again from what was read."""
    assert parse(url) == place
    assert parse(parse(url).url) == place


@pytest.mark.parametrize(
    "url",
    [
        "", "example.org", "//example.org", "ftp://example.org", "file:///etc/passwd", "gopher://example.org",
        "http://", "http:///x", "http://user@example.org", "http://user:pw@example.org", "http://@example.org",
        "http://good.example@evil.example", "http://good.example\\@evil.example", "http://exa mple.org",
        "http://example.org/\r\nX: y", "http://example.org/#x", "http://example.org:0", "http://example.org:65536",
        "http://example.org:x", "http://[::1", "http://[fe80::1%25eth0]/", "http://[v1.x]/", "http://exämple.org",
        "http://-x.example", "http://x..", "http://%6cocalhost", "http://1.2.3.4%00.example",
        "http://example.org\t", " http://example.org", "http://ⓔxample.org", "http://example.org/ü", "http://a_b/\x7f",
    ],
)  # fmt: skip
def test_what_two_might_read_in_two_ways_is_refused(url: str) -> None:
    """Users, fragments, blanks, other alphabets, what is no host."""
    with pytest.raises(Invalid, match="webhook's 'url'"):
        parse(url)


@pytest.mark.parametrize("host", ["my_hook.example.org", "a..example.org", f"{'a' * 64}.example.org"])
def test_a_name_that_no_certificate_can_have_is_refused(host: str) -> None:
    """When a rule is made; without TLS the system's resolver judges."""
    with pytest.raises(Invalid, match="no certificate can be for the host of this webhook's 'url'"):
        sender().check(f"https://{host}/")
    assert parse(f"http://{host}/").host == host


@pytest_twisted.ensureDeferred
async def test_a_rule_that_was_kept_with_such_a_name_says_why_it_fails() -> None:
    """It is not tried again, and nothing breaks."""
    error = await refused(sender(), "https://my_hook.example.org/")
    assert (error.again, "no certificate" in str(error)) == (False, True)
