"""Networks of this machine, read from its interfaces."""

from __future__ import annotations

import socket
from collections.abc import Callable
from ipaddress import ip_network
from typing import NamedTuple

import psutil
import pytest
import pytest_twisted

from relay_server.alerts import egress
from relay_server.alerts.egress import networks_of
from relay_server.alerts.schemas import Undelivered
from relay_server.alerts.transports import Transports
from tests.worlds.alert_receivers import REACTOR, WebhookResource, serve
from tests.worlds.alerts import message, rule

OURS = "93.184.215.14"


class Address(NamedTuple):
    """An address of an interface, in psutil's form."""

    family: int
    address: str
    netmask: str | None = None
    broadcast: str | None = None
    ptp: str | None = None


Interfaces = Callable[..., None]


@pytest.fixture
def interfaces(monkeypatch: pytest.MonkeyPatch) -> Interfaces:
    """Replaces the interfaces of this machine."""

    def has(*addresses: Address) -> None:
        monkeypatch.setattr(psutil, "net_if_addrs", lambda: {"eth0": list(addresses)})

    return has


@pytest.mark.parametrize(
    ("address", "netmask", "peer", "networks"),
    [
        ("93.184.215.14", "255.255.255.0", None, ["93.184.215.0/24"]),
        ("93.184.215.14", "255.255.255.255", None, ["93.184.215.14/32"]),
        ("93.184.215.14", None, None, ["93.184.215.14/32"]),
        ("93.184.215.14", "0.0.0.0", None, ["93.184.215.14/32"]),
        ("93.184.215.14", "254.0.0.0", None, ["93.184.215.14/32"]),
        ("93.184.215.14", "255.255.255.255", "93.184.216.1", ["93.184.215.14/32", "93.184.216.1/32"]),
        ("2606:2800:21f:cb07::5", "ffff:ffff:ffff:ffff::", None, ["2606:2800:21f:cb07::/64"]),
        ("2606:2800:21f:cb07::5", "ffff:ffff:ffff::", None, ["2606:2800:21f::/48"]),
        ("2606:2800:21f:cb07::5", "ffff:ffff:ffff:ffff:ffff:ffff:ffff:ffff", None, ["2606:2800:21f:cb07::/64"]),
        ("2606:2800:21f:cb07::5", "::", None, ["2606:2800:21f:cb07::/64"]),
        ("fe80::1%eth0", "ffff:ffff:ffff:ffff::", None, ["fe80::/64"]),
        ("52:54:00:12:34:56", None, None, []),
    ],
)  # fmt: skip
def test_an_address_stands_for_the_network_of_its_interface(
    address: str, netmask: str | None, peer: str | None, networks: list[str]
) -> None:
    assert networks_of(address, netmask, peer) == {ip_network(each) for each in networks}


def test_networks_of_this_machine_are_found() -> None:
    assert ip_network("127.0.0.0/8") in egress.local_networks()


@pytest_twisted.ensureDeferred
async def test_the_machines_own_addresses_are_reached_by_no_message(interfaces: Interfaces) -> None:
    """This holds for public addresses too: through them a user would pass the firewall of this machine and
    its neighbours.
    """
    ways = Transports(REACTOR, lambda: 0.0, (), ())
    interfaces(
        Address(socket.AF_INET, OURS, "255.255.255.240"),
        Address(socket.AF_INET6, "2606:2800:21f:cb07::5", "ffff:ffff:ffff:ffff::"),
    )
    for host in (OURS, "93.184.215.1", "[2606:2800:21f:cb07::1]", "[64:ff9b::5db8:d70e]"):
        with pytest.raises(Undelivered, match="does not send to"):
            await ways.send(rule(url=f"http://{host}:9/"), message())


@pytest_twisted.ensureDeferred
async def test_an_administrator_allows_and_denies(interfaces: Interfaces) -> None:
    webhook_receiver = WebhookResource()
    port = serve(webhook_receiver)
    url = f"http://127.0.0.1:{port.getHost().port}/"
    interfaces(Address(socket.AF_INET, "127.0.0.1", "255.0.0.0"))
    try:
        await Transports(REACTOR, lambda: 0.0, ["127.0.0.0/8"], ()).send(rule(url=url), message())
        assert len(webhook_receiver.got) == 1
        denies = Transports(REACTOR, lambda: 0.0, ["127.0.0.0/8"], (), ["127.0.0.1/32"])
        with pytest.raises(Undelivered, match="does not send to"):
            await denies.send(rule(url=url), message())
        assert len(webhook_receiver.got) == 1
    finally:
        await port.stopListening()


@pytest_twisted.ensureDeferred
async def test_a_system_that_hides_its_networks_sends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the cause, and the message is retried."""

    def fails() -> None:
        raise OSError(97, "Address family not supported by protocol")

    monkeypatch.setattr(psutil, "net_if_addrs", fails)
    with pytest.raises(Undelivered, match=r"which networks its machine is in.*not supported") as error:
        await Transports(REACTOR, lambda: 0.0, (), ()).send(rule(url="http://8.8.8.8/"), message())
    assert error.value.again
