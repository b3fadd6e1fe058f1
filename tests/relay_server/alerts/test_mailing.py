"""Messages through apprise: only by what the administrator allows, and nowhere within his networks."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest
import pytest_twisted
from switchboard_hook import MailServer
from twisted.internet.defer import CancelledError, Deferred

from relay_protocol.errors import Invalid
from relay_server.alerts.egress import EgressPolicy, NameResolver, parse_networks
from relay_server.alerts.email import DOUBTFUL, THREADS, Mailing
from relay_server.alerts.message import AlertNotice, NotificationMessage, Undelivered
from relay_server.alerts.transports import Transports, check_schemes
from tests.relay_server.alerts.made_up import alert, message, rule
from tests.relay_server.alerts.receiver import REACTOR


@pytest.fixture
def server() -> Iterator[MailServer]:
    """A mail server on this machine."""
    made = MailServer()
    yield made
    made.stop()


@pytest_twisted.async_yield_fixture
async def mailing() -> AsyncIterator[Mailing]:
    """Sends by mail alone, also to this machine."""
    names = NameResolver(REACTOR)
    made = Mailing(
        REACTOR, names.addresses, ["mailto"], EgressPolicy(frozenset, parse_networks(["127.0.0.0/8"]))
    )
    names.start()
    made.start()
    yield made
    made.stop()
    names.stop()


def url(server: MailServer, host: str = "127.0.0.1") -> str:
    """Of apprise, for this server."""
    way = f"smtp={host}&port={server.port}&mode=insecure"
    return f"mailto://relay.example?{way}&from=relay@x.example&to=ann@x.example"


def by(url: str) -> Any:
    """A rule that sends there."""
    return rule(channel="apprise", url=url, secret="")


@pytest_twisted.ensureDeferred
async def test_a_message_arrives_by_mail(mailing: Mailing, server: MailServer) -> None:
    """With a subject of one line, whatever a robot says."""
    evil = alert(kind="module", about="arm\r\nBcc: eve@x.example", text="gone\r\nX-Evil: yes")
    await mailing.send(by(url(server)), message(AlertNotice(evil, "begun")))
    (mail,) = server.mails
    assert "Subject: rover: error: module arm" in mail
    assert "\nBcc:" not in mail
    assert "\nX-Evil" not in mail
    assert "gone" in mail


@pytest_twisted.ensureDeferred
async def test_a_server_in_a_network_that_is_not_allowed_is_not_reached(server: MailServer) -> None:
    """By address or by name."""
    names = NameResolver(REACTOR)
    mailing = Mailing(REACTOR, names.addresses, ["mailto"], EgressPolicy(frozenset))
    names.start()
    mailing.start()
    try:
        for host in ("127.0.0.1", "localhost"):
            with pytest.raises(Undelivered, match="does not send to"):
                await mailing.send(by(url(server, host)), message())
    finally:
        mailing.stop()
        names.stop()
    assert server.mails == []


@pytest_twisted.ensureDeferred
async def test_only_allowed_services_are_taken(mailing: Mailing, server: MailServer) -> None:
    """When a rule is made, and again when it sends: settings change."""
    await mailing.check(url(server))
    for wrong in ("json://example.org/x", "mailto", "", "file:///etc/passwd", "mailto://"):
        with pytest.raises(Invalid):
            await mailing.check(wrong)
    with pytest.raises(Undelivered, match="may not have the parameter 'wkd'"):
        await mailing.send(by(url(server) + "&WKD=yes"), message())
    with pytest.raises(Undelivered, match="does not allow"):
        await mailing.send(by("json://example.org/x"), message())


@pytest_twisted.ensureDeferred
async def test_a_server_that_is_not_there_is_told_in_words(
    mailing: Mailing, caplog: pytest.LogCaptureFixture
) -> None:
    """And nothing of the URL is logged."""
    server = MailServer()
    server.stop()
    with caplog.at_level(logging.DEBUG), pytest.raises(Undelivered, match="did not take") as error:
        await mailing.send(by(url(server) + "&pass=topsecret&user=ann"), message())
    assert error.value.again
    assert "topsecret" not in caplog.text


@pytest_twisted.ensureDeferred
async def test_a_message_waits_for_a_thread_before_it_is_judged(mailing: Mailing) -> None:
    """Those that did not arrive before get half of them; who gives up waiting leaves no place taken."""
    there: list[bool] = []
    leave: Deferred[None] = Deferred()

    async def stays(doubtful: bool) -> None:
        async with mailing.room(doubtful):
            there.append(doubtful)
            await leave

    staying = [Deferred.fromCoroutine(stays(True)) for _ in range(THREADS)]
    assert there == [True] * DOUBTFUL
    staying += [Deferred.fromCoroutine(stays(False)) for _ in range(THREADS)]
    assert there == [True] * DOUBTFUL + [False] * (THREADS - DOUBTFUL)
    for each in (staying.pop(DOUBTFUL), staying.pop()):
        each.addErrback(lambda failure: failure.trap(CancelledError))
        each.cancel()
    leave.callback(None)
    for each in staying:
        await each
    assert sorted(there) == [False] * (THREADS - 1) + [True] * (THREADS - 1)


def test_a_long_message_says_how_many_more_there_are() -> None:
    """People get lines, and a number."""
    many = NotificationMessage("d1", [AlertNotice(alert(f"a{number}"), "begun") for number in range(50)], 7)
    assert many.title == "57 alerts"
    assert many.text.splitlines()[-1] == "and 37 more"
    assert len(many.text.splitlines()) == 21


@pytest.mark.parametrize("scheme", ["file", "syslog", "https", "mail-to", "", "mailto://"])
def test_what_works_on_the_relays_own_machine_can_not_be_allowed(scheme: str) -> None:
    """Nor what is no scheme."""
    with pytest.raises(Invalid, match="is no scheme"):
        check_schemes([scheme])


def test_without_schemes_there_is_no_apprise() -> None:
    """The channel is not offered."""
    ways = Transports(REACTOR, lambda: 0.0, (), ())
    assert (ways.channels, ways.schemes) == (("portal", "webhook"), [])
    assert Transports(REACTOR, lambda: 0.0, (), ("mailtos",)).channels[-1] == "apprise"
