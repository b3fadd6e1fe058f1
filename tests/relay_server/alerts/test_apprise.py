"""Messages through apprise: only services that the administrator allows, and no address of the relay's
networks.
"""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError, Deferred

from relay_protocol.errors import Invalid
from relay_server.alerts.apprise import FAILING_THREADS, THREADS, AppriseTransport, check_schemes
from relay_server.alerts.egress import EgressPolicy, NameResolver, parse_networks
from relay_server.alerts.schemas import AlertNotice, NotificationMessage, Undelivered
from relay_server.alerts.transports import Transports
from tests.worlds.alert_receivers import REACTOR
from tests.worlds.alerts import alert, message, rule
from tests.worlds.webhook_server import MailServer


@pytest.fixture
def server() -> Iterator[MailServer]:
    """A mail server on this machine."""
    made = MailServer()
    yield made
    made.stop()


@pytest_twisted.async_yield_fixture
async def apprise() -> AsyncIterator[AppriseTransport]:
    """Sends by mail only, also to this machine."""
    names = NameResolver(REACTOR)
    made = AppriseTransport(
        REACTOR, names.addresses, ["mailto"], EgressPolicy(frozenset, parse_networks(["127.0.0.0/8"]))
    )
    names.start()
    made.start()
    yield made
    made.stop()
    names.stop()


def url(server: MailServer, host: str = "127.0.0.1") -> str:
    """A URL of apprise for this server."""
    options = f"smtp={host}&port={server.port}&mode=insecure"
    return f"mailto://relay.example?{options}&from=relay@x.example&to=ann@x.example"


def by(url: str) -> Any:
    """A rule that sends there."""
    return rule(channel="apprise", url=url, secret="")


@pytest_twisted.ensureDeferred
async def test_a_message_arrives_by_mail(apprise: AppriseTransport, server: MailServer) -> None:
    """The subject is one line, even if a robot's text has line breaks."""
    evil = alert(kind="module", about="arm\r\nBcc: eve@x.example", text="gone\r\nX-Evil: yes")
    await apprise.send(by(url(server)), message(AlertNotice(evil, "begun")))
    (mail,) = server.mails
    assert "Subject: rover: error: module arm" in mail
    assert "\nBcc:" not in mail
    assert "\nX-Evil" not in mail
    assert "gone" in mail


@pytest_twisted.ensureDeferred
async def test_a_server_in_a_network_that_is_not_allowed_is_not_reached(server: MailServer) -> None:
    names = NameResolver(REACTOR)
    apprise = AppriseTransport(REACTOR, names.addresses, ["mailto"], EgressPolicy(frozenset))
    names.start()
    apprise.start()
    try:
        for host in ("127.0.0.1", "localhost"):
            with pytest.raises(Undelivered, match="does not send to"):
                await apprise.send(by(url(server, host)), message())
    finally:
        apprise.stop()
        names.stop()
    assert server.mails == []


@pytest_twisted.ensureDeferred
async def test_only_allowed_services_are_taken(apprise: AppriseTransport, server: MailServer) -> None:
    """Schemes are checked when a rule is made and again when it sends, because settings change."""
    await apprise.check(url(server))
    for wrong in ("json://example.org/x", "mailto", "", "file:///etc/passwd", "mailto://"):
        with pytest.raises(Invalid):
            await apprise.check(wrong)
    with pytest.raises(Undelivered, match="must not have the parameter 'wkd'"):
        await apprise.send(by(url(server) + "&WKD=yes"), message())
    with pytest.raises(Undelivered, match="no longer allows"):
        await apprise.send(by("json://example.org/x"), message())


@pytest_twisted.ensureDeferred
async def test_an_absent_server_has_a_clear_error(
    apprise: AppriseTransport, caplog: pytest.LogCaptureFixture
) -> None:
    server = MailServer()
    server.stop()
    with caplog.at_level(logging.DEBUG), pytest.raises(Undelivered, match="did not accept") as error:
        await apprise.send(by(url(server) + "&pass=topsecret&user=ann"), message())
    assert error.value.again
    assert "topsecret" not in caplog.text


@pytest_twisted.ensureDeferred
async def test_a_message_waits_for_a_thread_before_it_is_judged(apprise: AppriseTransport) -> None:
    there: list[bool] = []
    leave: Deferred[None] = Deferred()

    async def stays(failing: bool) -> None:
        async with apprise.slot(failing):
            there.append(failing)
            await leave

    staying = [Deferred.fromCoroutine(stays(True)) for _ in range(THREADS)]
    assert there == [True] * FAILING_THREADS
    staying += [Deferred.fromCoroutine(stays(False)) for _ in range(THREADS)]
    assert there == [True] * FAILING_THREADS + [False] * (THREADS - FAILING_THREADS)
    for each in (staying.pop(FAILING_THREADS), staying.pop()):
        each.addErrback(lambda failure: failure.trap(CancelledError))
        each.cancel()
    leave.callback(None)
    for each in staying:
        await each
    assert sorted(there) == [False] * (THREADS - 1) + [True] * (THREADS - 1)


def test_a_long_message_has_the_number_of_the_rest() -> None:
    """The message has a few lines and the number of the other alerts."""
    many = NotificationMessage("d1", [AlertNotice(alert(f"a{number}"), "begun") for number in range(50)], 7)
    assert many.title == "57 alerts"
    assert many.text.splitlines()[-1] == "and 37 more"
    assert len(many.text.splitlines()) == 21


@pytest.mark.parametrize("scheme", ["file", "syslog", "https", "mail-to", "", "mailto://"])
def test_schemes_that_act_on_the_relays_machine_cannot_be_allowed(scheme: str) -> None:
    with pytest.raises(Invalid, match="cannot be allowed"):
        check_schemes([scheme])


def test_without_schemes_there_is_no_apprise() -> None:
    """The channel is not offered."""
    ways = Transports(REACTOR, lambda: 0.0, (), ())
    assert (ways.channels, ways.schemes) == (("portal", "webhook"), [])
    assert Transports(REACTOR, lambda: 0.0, (), ("mailtos",)).channels[-1] == "apprise"
