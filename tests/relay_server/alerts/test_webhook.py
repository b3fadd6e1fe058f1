"""Messages are signed, reach only their receiver, and no address in a network that is not allowed."""

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
from relay_server.alerts.schemas import Undelivered
from relay_server.alerts.webhook import ANSWER_BYTES, WebhookTransport, parse, signature
from tests.worlds.alert_receivers import REACTOR, WebhookResource, certificate, raw, serve
from tests.worlds.alerts import SECRET, message, rule

LOOPBACK = parse_networks(["127.0.0.0/8", "::1/128"])


class Resolver:
    """Answers with the test's lists of addresses, one after another; the last one is repeated."""

    def __init__(self, *answers: list[str]) -> None:
        self.answers = list(answers)
        self.asked: list[tuple[str, int]] = []

    async def __call__(self, host: str, port: int, user: int) -> list[str]:
        self.asked.append((host, port))
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]


class Scene:
    """Receivers and a sender."""

    def __init__(self) -> None:
        self.ports: list[Any] = []

    def open(self, port: Any) -> int:
        """Listens until the test ends; returns the port."""
        self.ports.append(port)
        return int(port.getHost().port)

    async def close(self) -> None:
        for each in self.ports:
            await each.stopListening()


def sender(resolver: Any = None, allowed: Any = LOOPBACK, trust: Any = None) -> WebhookTransport:
    """Sends only to this machine, unless other networks are given."""
    policy = EgressPolicy(frozenset, allowed)
    made = WebhookTransport(REACTOR, resolver or Resolver(["127.0.0.1"]), policy, lambda: 1700000000.9, trust)
    made.relay = "relay-1"
    return made


@pytest_twisted.async_yield_fixture
async def scene() -> AsyncIterator[Scene]:
    """A scene without a listening receiver."""
    made = Scene()
    yield made
    await made.close()


async def refused(webhooks: WebhookTransport, url: str) -> Undelivered:
    """The error of a message that is not sent."""
    with pytest.raises(Undelivered) as error:
        await webhooks.send(rule(url=url), message())
    return error.value


@pytest_twisted.ensureDeferred
async def test_the_signature_covers_body_and_time(scene: Scene) -> None:
    """The body follows the contract; the signature covers its bytes and the time."""
    webhook_receiver = WebhookResource()
    port = scene.open(serve(webhook_receiver))
    await sender().send(rule(url=f"http://hooks.example:{port}/a/b?c=d"), message(left_out=3))
    ((request, body),) = webhook_receiver.got
    assert (request.method, request.uri) == (b"POST", b"/a/b?c=d")
    assert request.getHeader("host") == f"hooks.example:{port}"
    assert request.getHeader("content-type") == "application/json"
    assert request.getHeader("switchboard-delivery") == "d1"
    assert request.getHeader("switchboard-timestamp") == "1700000000"
    expected = hmac.new(SECRET.encode(), b"1700000000." + body, hashlib.sha256).hexdigest()
    assert request.getHeader("switchboard-signature") == f"v1={expected}"
    assert signature(SECRET, "1700000000", body) == f"v1={expected}"
    reported = json.loads(body)
    assert {each: reported[each] for each in ("relay", "delivery", "rule", "left_out")} == {
        "relay": "relay-1",
        "delivery": "d1",
        "rule": 7,
        "left_out": 3,
    }
    (alert,) = reported["alerts"]
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
    """The name is resolved once for each try and judged each time, because its address may change."""
    webhook_receiver = WebhookResource()
    port = scene.open(serve(webhook_receiver))
    url = f"http://rebound.example:{port}/"
    resolver = Resolver(["127.0.0.1"], ["10.0.0.7"], ["::ffff:169.254.169.254"])
    webhooks = sender(resolver)
    await webhooks.send(rule(url=url), message())
    assert (len(webhook_receiver.got), len(resolver.asked)) == (1, 1)
    for _ in range(2):
        assert "does not send to" in str(await refused(webhooks, url))
    assert len(webhook_receiver.got) == 1


@pytest_twisted.ensureDeferred
async def test_internal_and_unknown_names_have_the_same_error() -> None:
    """Otherwise users could probe names of the relay's networks. Both are retried equally often."""
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
    webhook_receiver = WebhookResource()
    port = scene.open(serve(webhook_receiver, "127.0.0.2"))
    resolver = Resolver(["127.0.0.1", "10.0.0.7", "127.0.0.2"])
    await sender(resolver, parse_networks(["127.0.0.2/32"])).send(
        rule(url=f"http://x.example:{port}/"), message()
    )
    assert len(webhook_receiver.got) == 1


@pytest_twisted.ensureDeferred
async def test_the_next_address_is_tried_if_one_does_not_answer(scene: Scene) -> None:
    webhook_receiver = WebhookResource()
    port = scene.open(serve(webhook_receiver, "127.0.0.2"))
    # Another program may use the same port of 127.0.0.1; none listens at 127.0.0.3.
    resolver = Resolver(["127.0.0.3", "127.0.0.2"])
    await sender(resolver).send(rule(url=f"http://x.example:{port}/"), message())
    assert len(webhook_receiver.got) == 1


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
    """The system resolves the name, and the resulting address is judged."""
    webhook_receiver = WebhookResource()
    port = scene.open(serve(webhook_receiver))
    names = NameResolver(REACTOR)
    names.start()
    try:
        error = await refused(sender(names.addresses, ()), f"http://{host}:{port}/")
    finally:
        names.stop()
    assert "does not send to" in str(error)
    assert webhook_receiver.got == []


@pytest_twisted.ensureDeferred
async def test_a_redirect_is_not_followed(scene: Scene) -> None:
    """A redirect may lead to any address."""
    inside, webhook_receiver = WebhookResource(), WebhookResource(302)
    webhook_receiver.headers = {"location": f"http://127.0.0.1:{scene.open(serve(inside))}/"}
    error = await refused(sender(), f"http://x.example:{scene.open(serve(webhook_receiver))}/")
    assert (str(error), error.again) == ("x.example answered with the status 302", False)
    assert (len(webhook_receiver.got), inside.got) == (1, [])


@pytest.mark.parametrize(
    ("status", "again"),
    [(400, False), (404, False), (408, True), (410, False), (429, True), (500, True), (503, True)],
)
@pytest_twisted.ensureDeferred
async def test_temporary_failures_are_tried_again(scene: Scene, status: int, again: bool) -> None:
    """A permanent refusal is not retried."""
    error = await refused(sender(), f"http://x.example:{scene.open(serve(WebhookResource(status)))}/")
    assert error.again is again


@pytest_twisted.ensureDeferred
async def test_a_receiver_that_never_answers_is_given_up(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SEND_SECONDS", 0.3)
    webhook_receiver = WebhookResource(0)
    error = await refused(sender(), f"http://x.example:{scene.open(serve(webhook_receiver))}/")
    assert error.again
    assert "did not answer" in str(error)
    ((request, _),) = webhook_receiver.got
    while not request._disconnected:
        await deferLater(REACTOR, 0.01)


@pytest_twisted.ensureDeferred
async def test_an_endless_answer_is_cut(scene: Scene) -> None:
    """Endless headers or lines: reading stops after a small limit."""
    sent = [0]

    def flood(transport: Any) -> None:
        sent[0] += 1
        transport.write(b"HTTP/1.1 200 OK\r\n" + b"X-Y: " + b"z" * 8000 + b"\r\n")
        for _ in range(2 * ANSWER_BYTES // 8000):
            transport.write(b"X-Y: " + b"z" * 8000 + b"\r\n")

    error = await refused(sender(), f"http://x.example:{scene.open(raw(flood))}/")
    assert (str(error), error.again) == ("x.example closed the connection before it answered", True)


@pytest.mark.parametrize("says", [b"", b"SSH-2.0-OpenSSH_9.2\r\n", b"\x00" * 1000])
@pytest_twisted.ensureDeferred
async def test_a_peer_without_http_has_a_clear_error(scene: Scene, says: bytes) -> None:
    """The peer's bytes are not shown to the user."""

    def behave(transport: Any) -> None:
        transport.write(says)
        transport.loseConnection()

    error = await refused(sender(), f"http://x.example:{scene.open(raw(behave))}/")
    assert str(error) == "x.example closed the connection before it answered"


@pytest_twisted.ensureDeferred
async def test_a_refused_connection_has_a_clear_error(scene: Scene) -> None:
    """It is retried."""
    port = serve(WebhookResource())
    number = port.getHost().port
    await port.stopListening()
    error = await refused(sender(), f"http://x.example:{number}/")
    assert (str(error), error.again) == (f"x.example does not accept connections on port {number}", True)


@pytest_twisted.ensureDeferred
async def test_tls_is_checked_by_name_and_signer(scene: Scene, tmp_path: Path) -> None:
    webhook_receiver = WebhookResource()
    options, trusted = certificate(tmp_path, "good.example")
    port = scene.open(serve(webhook_receiver, tls=options))
    await sender(trust=trusted).send(rule(url=f"https://good.example:{port}/"), message())
    assert len(webhook_receiver.got) == 1
    for host, trust in (("other.example", trusted), ("good.example", None)):
        error = await refused(sender(trust=trust), f"https://{host}:{port}/")
        assert "no certificate" in str(error)
    plain = scene.open(raw(lambda transport: transport.write(b"HTTP/1.1 400 Bad Request\r\n\r\n")))
    assert "does not speak TLS" in str(await refused(sender(), f"https://good.example:{plain}/"))
    assert len(webhook_receiver.got) == 1


@pytest_twisted.ensureDeferred
async def test_an_unknown_name_has_a_clear_error() -> None:
    """No answer of a name server can make the relay fail."""
    names = NameResolver(REACTOR)
    names.start()
    try:
        for host in ("no-such-host.invalid", "a" * 64 + ".example", ".".join(["abc"] * 60)):
            error = await refused(sender(names.addresses), f"http://{host}/")
            assert "no address of" in str(error)
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
def test_addresses_of_webhooks_are_unambiguous(url: str, place: tuple[object, ...]) -> None:
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
def test_ambiguous_urls_are_refused(url: str) -> None:
    """These contain user names, fragments, blanks, other alphabets or invalid hosts."""
    with pytest.raises(Invalid, match="webhook's 'url'"):
        parse(url)


@pytest.mark.parametrize("host", ["my_hook.example.org", "a..example.org", f"{'a' * 64}.example.org"])
def test_a_name_that_no_certificate_can_have_is_refused(host: str) -> None:
    """It is refused when a rule is made; without TLS the system's resolver decides."""
    with pytest.raises(Invalid, match="no certificate can be valid for the host of this webhook's 'url'"):
        sender().check(f"https://{host}/")
    assert parse(f"http://{host}/").host == host


@pytest_twisted.ensureDeferred
async def test_a_stored_rule_with_an_invalid_name_reports_why_it_fails() -> None:
    """The message is not retried."""
    error = await refused(sender(), "https://my_hook.example.org/")
    assert (error.again, "no certificate" in str(error)) == (False, True)
