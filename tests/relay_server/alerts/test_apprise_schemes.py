"""No parameter of a URL makes apprise read a file of the relay's machine, or fetch an address of its networks."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import orjson
import pytest
import pytest_twisted
from twisted.protocols.portforward import ProxyFactory, ProxyServer

from relay_protocol.errors import Invalid
from relay_server.alerts.apprise import CLOUDS, PARAMETERS, SERVERS, AppriseTransport
from relay_server.alerts.egress import EgressPolicy, NameResolver, parse_networks
from relay_server.alerts.schemas import Undelivered
from tests.worlds.alert_receivers import REACTOR, WebhookResource, certificate, serve
from tests.worlds.alerts import message, rule

SLACK = "slack://T1JJ3T3L2/A1BRTD4JD/TIiajkdnlazkcOXrIdevi7FQ"
DISCORD = f"discord://{'1' * 18}/{'a' * 64}"
TELEGRAM = "tgram://123456789:abcdefg_hijklmnop/987654321"
MAIL = "mailtos://ann:password@mail.example.org"
TEAMS = f"workflows://prod-1.example.org/{'a' * 32}/{'b' * 43}"


class Scene:
    """Apprise with all its services, and a server on this machine that must not be reached."""

    def __init__(self, allowed: str = "") -> None:
        self.webhook_receiver = WebhookResource()
        self.port = serve(self.webhook_receiver)
        self.names = NameResolver(REACTOR)
        policy = EgressPolicy(frozenset, parse_networks([allowed] if allowed else []))
        self.apprise = AppriseTransport(REACTOR, self.names.addresses, list(PARAMETERS), policy)
        self.names.start()
        self.apprise.start()

    @property
    def place(self) -> str:
        """Host and port of the server."""
        return f"127.0.0.1:{self.port.getHost().port}"

    async def fails(self, url: str) -> Undelivered:
        """The error of a message that is sent by this URL."""
        with pytest.raises(Undelivered) as error:
            await self.apprise.send(rule(channel="apprise", url=url, secret=""), message())
        return error.value

    async def close(self) -> None:
        self.apprise.stop()
        self.names.stop()
        await self.port.stopListening()


@pytest_twisted.async_yield_fixture
async def scene() -> AsyncIterator[Scene]:
    """A scene in which no special network is allowed."""
    made = Scene()
    yield made
    await made.close()


@pytest_twisted.async_yield_fixture
async def open_scene() -> AsyncIterator[Scene]:
    """A scene in which this machine is allowed."""
    made = Scene("127.0.0.0/8")
    yield made
    await made.close()


@pytest.mark.parametrize(
    ("url", "name"),
    [
        (f"{SLACK}?template=/etc/hostname", "template"),
        (f"{SLACK}?footer=no&template=http://127.0.0.1/admin", "template"),
        (f"{SLACK}?footer=no;template=/etc/hostname", "template"),
        (f"{SLACK}?TEMPLATE=/etc/hostname", "template"),
        (f"{SLACK}?%74emplate=/etc/hostname", "template"),
        (f"{SLACK}?%20template=/etc/hostname", "+template"),
        (f"{SLACK}?template", "template"),
        (f"{SLACK}?:name=value", ":name"),
        (f"{SLACK}?redirect=yes", "redirect"),
        (f"{DISCORD}?template=/etc/hostname", "template"),
        (f"{DISCORD}?avatar_url=http://127.0.0.1/", "avatar_url"),
        (f"{TELEGRAM}?template=/etc/hostname", "template"),
        (f"{TEAMS}?template=/etc/hostname", "template"),
        (f"{MAIL}?pgp=yes", "pgp"),
        (f"{MAIL}?pgppub=file:///etc/hostname", "pgppub"),
        (f"{MAIL}?pgpprv=/etc/hostname", "pgpprv"),
        (f"{MAIL}?wkd=yes", "wkd"),
        (f"{MAIL}?+X-Header=value", "+X-Header"),
        (f"{MAIL}?%20to=ann@example.org", "+to"),
        (f"{MAIL}?cto=600", "cto"),
        (f"{MAIL}?rto=600", "rto"),
        (f"{MAIL}?retry=9", "retry"),
        (f"{MAIL}?tags=a", "tags"),
        ("ntfys://ntfy.example.org/topic?attach=http://127.0.0.1/x", "attach"),
        ("jsons://example.org/x?+Metadata-Flavor=Google", "+Metadata-Flavor"),
        ("jsons://example.org/x?-key=value", "-key"),
        ("jsons://example.org/x?:key=value", ":key"),
        ("jsons://example.org/x?method=DELETE", "method"),
    ],
)
@pytest_twisted.ensureDeferred
async def test_a_parameter_that_is_not_known_as_harmless_is_refused(
    scene: Scene, url: str, name: str
) -> None:
    words = f"must not have the parameter '{name}'"
    with pytest.raises(Invalid) as error:
        await scene.apprise.check(url)
    assert words in str(error.value)
    late = await scene.fails(url)
    assert (words in str(late), late.again) == (True, False)


@pytest_twisted.ensureDeferred
async def test_refused_rule_fetches_no_address(scene: Scene) -> None:
    inside = quote(f"http://{scene.place}/admin", safe="")
    forms = ("?template={}", "?a=b;template={}")
    urls = [url + form.format(inside) for url in (SLACK, DISCORD, TELEGRAM, TEAMS) for form in forms]
    for url in urls:
        await scene.fails(url)
    assert scene.webhook_receiver.got == []
    for url in urls:
        with pytest.raises(Invalid):
            await scene.apprise.check(url)
    assert scene.webhook_receiver.got == []


@pytest.mark.parametrize(
    "url",
    [
        f"{SLACK}/%23general?footer=no&format=text",
        f"{DISCORD}?tts=no&thread=123",
        f"{TELEGRAM}?silent=yes&topic=7",
        TEAMS,
        f"{MAIL}?smtp=mail.example.org&port=465&from=relay@example.org&to=ann@example.org&mode=ssl",
        "ntfys://ntfy.example.org/topic?priority=high",
        "ntfy://mytopic",
        "ntfys://mytopic?priority=high",
        "gotifys://gotify.example.org/abcdefghijklmno?priority=high",
        "mmosts://chat.example.org/3ccdd113474722377935511fc85d3dd4?channel=robots",
        "jsons://ann:password@example.org:8443/a/b?verify=no",
        "opsgenie://a1b2c3d4-a1b2-a1b2-a1b2-a1b2c3d4e5f6/?priority=high&",
    ],
)
@pytest_twisted.ensureDeferred
async def test_urls_in_usual_notations_are_accepted(scene: Scene, url: str) -> None:
    await scene.apprise.check(url)


@pytest.mark.parametrize("scheme", ["fcm", "vapid", "matrixs", "zulip", "apprise", "nonsense"])
def test_a_service_that_was_not_looked_at_can_not_be_allowed(scheme: str) -> None:
    """Push services read key files, others fetch addresses that users choose. The error lists the allowed
    services.
    """
    with pytest.raises(Invalid, match=f"'{scheme}' cannot be allowed.*mailtos.*slack"):
        AppriseTransport(
            REACTOR, NameResolver(REACTOR).addresses, ["mailtos", scheme], EgressPolicy(frozenset)
        )


def test_the_lists_have_nothing_that_names_a_file_or_an_address() -> None:
    suspicious = (
        "template",
        "file",
        "pgp",
        "wkd",
        "attach",
        "url",
        "icon",
        "image",
        "redirect",
        "cto",
        "rto",
    )
    for scheme, names in PARAMETERS.items():
        assert [each for each in names if any(word in each for word in suspicious)] == [], scheme


def test_services_are_from_apprise_and_own_servers_are_recognised() -> None:
    import apprise

    found = {
        scheme: any("{host}" in each for each in entry["details"]["templates"])
        for entry in apprise.Apprise().details()["schemas"]
        for scheme in (*(entry["protocols"] or ()), *(entry["secure_protocols"] or ()))
    }
    assert {each: found[each] for each in PARAMETERS} == {each: each in SERVERS for each in PARAMETERS}


def test_a_service_with_a_server_of_its_own_and_others_of_the_users_choice_is_known_as_one() -> None:
    import apprise

    both = set()
    for entry in apprise.Apprise().details()["schemas"]:
        templates = entry["details"]["templates"]
        hosts = [each for each in templates if "{host}" in each]
        if hosts and len(hosts) < len(templates):
            both.update((*(entry["protocols"] or ()), *(entry["secure_protocols"] or ())))
    assert both & set(PARAMETERS) == set(CLOUDS)


class Proxy(ProxyServer):
    """A proxy that leads every HTTPS connection to one server of this machine and records the requested
    targets.
    """

    reactor = REACTOR

    def connectionMade(self) -> None:
        """The first line of a connection names its target."""

    def dataReceived(self, data: bytes) -> None:
        """Reads the target, then passes all bytes on."""
        if self.peer is not None:
            super().dataReceived(data)
            return
        self.factory.asked.append(data.split()[1].decode())
        self.transport.write(b"HTTP/1.1 200 OK\r\n\r\n")
        super().connectionMade()


@pytest.mark.parametrize("url", ["ntfy://mytopic", "ntfys://mytopic?priority=high"])
@pytest_twisted.ensureDeferred
async def test_a_message_to_a_topic_of_ntfy_sh_arrives_there(
    scene: Scene, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown, trusted = certificate(tmp_path, "ntfy.sh")
    (tmp_path / "ca.pem").write_bytes(trusted.dumpPEM())
    webhook_receiver = WebhookResource(200)
    server = serve(webhook_receiver, tls=shown)
    factory: Any = ProxyFactory("127.0.0.1", server.getHost().port)
    factory.protocol, factory.asked, factory.noisy = Proxy, [], False
    proxy = REACTOR.listenTCP(0, factory, interface="127.0.0.1")
    monkeypatch.setenv("https_proxy", f"http://127.0.0.1:{proxy.getHost().port}")
    monkeypatch.setenv("no_proxy", "")
    monkeypatch.setenv("REQUESTS_CA_BUNDLE", str(tmp_path / "ca.pem"))
    try:
        await scene.apprise.send(rule(channel="apprise", url=url, secret=""), message())
    finally:
        await proxy.stopListening()
        await server.stopListening()
    assert factory.asked == ["ntfy.sh:443"]
    ((_, body),) = webhook_receiver.got
    assert orjson.loads(body)["topic"] == "mytopic"


@pytest.mark.parametrize(
    "form",
    [
        "json://{}/x",
        "json://localhost:{port}/x",
        "json://2130706433:{port}/x",
        "gotify://{}/abcdefghijklmno",
        "mmost://{}/3ccdd113474722377935511fc85d3dd4",
        "ntfy://{}/topic",
        "ntfy://{}?to=topic",
        "ntfy://ann:password@{}/topic",
        "mailto://ann:password@example.org?smtp=127.0.0.1&port={port}&mode=insecure",
        f"workflows://{{}}/{'a' * 32}/{'b' * 43}",
    ],
)
@pytest_twisted.ensureDeferred
async def test_a_server_of_the_users_choice_is_judged_like_that_of_a_webhook(scene: Scene, form: str) -> None:
    """This holds for every service and every spelling of the address."""
    error = await scene.fails(form.format(scene.place, port=scene.port.getHost().port))
    assert "does not send to" in str(error)
    assert scene.webhook_receiver.got == []


@pytest.mark.parametrize("host", ["127.0.0.1%2Fx", "a.example%3A25", "a.example%3Fx", "b%40a.example"])
@pytest_twisted.ensureDeferred
async def test_an_ambiguous_host_is_refused(scene: Scene, host: str) -> None:
    error = await scene.fails(f"{MAIL}?smtp={host}")
    assert (str(error), error.again) == ("the host in the URL is not a plain name or address", False)


@pytest_twisted.ensureDeferred
async def test_a_redirect_of_such_a_server_is_not_followed(open_scene: Scene) -> None:
    """A redirect may lead to any address."""
    inside = WebhookResource(200)
    port = serve(inside)
    open_scene.webhook_receiver.status = 302
    open_scene.webhook_receiver.headers = {"location": f"http://127.0.0.1:{port.getHost().port}/"}
    try:
        error = await open_scene.fails(f"json://{open_scene.place}/x")
    finally:
        await port.stopListening()
    assert (str(error), error.again) == ("the service did not accept the message", True)
    assert (len(open_scene.webhook_receiver.got), inside.got) == (1, [])


@pytest.mark.parametrize(
    "url", ["tgram://", "tgram://123456789:", "slack://[", "jsons://", "discord://x", "mailto://["]
)
@pytest_twisted.ensureDeferred
async def test_urls_that_apprise_does_not_accept_have_a_clear_error(scene: Scene, url: str) -> None:
    with pytest.raises(Invalid, match="does not accept this URL of"):
        await scene.apprise.check(url)
