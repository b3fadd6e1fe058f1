"""DDS transport of the daemon, its guard and its camera process: with Fast DDS only UDP.

Between processes of one machine Fast DDS prefers shared memory. A sender takes a lock in the memory of the
receiver. If a receiver is suspended while it holds the lock, the sender waits up to a second, repeatedly
(Fast DDS 2.14: one freeze in 30 at 2,000 messages per second). A node that discovers it then waits for
thirds of a second until it shows signs of life. So a suspended daemon would block the robot's base while it
publishes odometry, and the base would not receive the guard's stop. A UDP socket never blocks the sender.
"""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from relay_protocol.errors import Unavailable
from robot_client.temporary import temporary_parent

_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Variables for the settings of Fast DDS 2 and 3."""

_USER_SETTINGS = (*_PROFILES, "FASTDDS_BUILTIN_TRANSPORTS")
"""If one is set, the robot's owner has chosen its transports, and nothing is changed."""

_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_LOCALHOST_ONLY = "ROS_LOCALHOST_ONLY"
_PEERS = "ROS_STATIC_PEERS"

BUFFER = 4 * 1024 * 1024
"""Requested bytes of socket buffers: some large images. ``net.core.rmem_max`` may allow less."""

_PARTICIPANTS = 100
"""Participants of one machine that are discovered, of the 120 that have ports in a domain (DDSI-RTPS
9.6.1.1). The last domain has room for fewer."""

_DOMAIN = "ROS_DOMAIN_ID"
_LAST_DOMAIN = 232
_LAST_PORT = 65535

_PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <profiles>
    <transport_descriptors>
      <transport_descriptor>
        <transport_id>udp</transport_id>
        <type>UDPv4</type>
        <sendBufferSize>{buffer}</sendBufferSize>
        <receiveBufferSize>{buffer}</receiveBufferSize>
        <maxInitialPeersRange>{participants}</maxInitialPeersRange>{interfaces}
      </transport_descriptor>
    </transport_descriptors>
    <participant profile_name="udp" is_default_profile="true">
      <rtps>
        <userTransports><transport_id>udp</transport_id></userTransports>
        <useBuiltinTransports>false</useBuiltinTransports>{builtin}
      </rtps>
    </participant>
  </profiles>
</dds>
"""
_INTERFACES = """
        <interfaceWhiteList><address>127.0.0.1</address></interfaceWhiteList>"""
_BUILTIN = """
        <builtin>
          <metatrafficUnicastLocatorList><locator><udpv4/></locator></metatrafficUnicastLocatorList>
          <initialPeersList>{peers}</initialPeersList>
        </builtin>"""
_PEER = "<locator><udpv4><address>{address}</address></udpv4></locator>"


@contextmanager
def without_shared_memory(middleware: str) -> Iterator[None]:
    """Nodes created in this context, the first of a process, do not use shared memory.

    :param middleware: from ``rclpy.get_rmw_implementation_identifier``
    :raises Unavailable: ``ROS_STATIC_PEERS`` names an unknown host, or the domain has no ports
    """
    if not middleware.startswith("rmw_fastrtps"):
        yield
        return
    # Fast DDS ends the process where a port is too high, or hangs in its own exit handlers.
    _participants(os.environ)
    if any(os.environ.get(each) for each in _USER_SETTINGS):
        yield
        return
    with tempfile.TemporaryDirectory(prefix="switchboard-dds-", dir=temporary_parent()) as folder:
        file = Path(folder, "udp.xml")
        file.write_text(profile(os.environ), encoding="utf-8")
        before = dict(os.environ)
        os.environ.update(dict.fromkeys(_PROFILES, str(file)))
        if on_this_machine(before):
            # Limited to this machine, rmw_fastrtps would set its own transports, among them shared memory.
            os.environ[_RANGE] = "SYSTEM_DEFAULT"
            os.environ.pop(_LOCALHOST_ONLY, None)
        try:
            yield
        finally:
            for name in (*_PROFILES, _RANGE, _LOCALHOST_ONLY):
                os.environ.pop(name, None)
                if name in before:
                    os.environ[name] = before[name]


def profile(environment: Mapping[str, str]) -> str:
    """XML profile of Fast DDS with UDP only, which respects the discovery settings of ROS 2.

    :raises Unavailable: ``ROS_STATIC_PEERS`` names an unknown host, or the domain has no ports
    """
    interfaces = builtin = ""
    if on_this_machine(environment):
        peers = [_address(each.strip()) for each in environment.get(_PEERS, "").split(";") if each.strip()]
        if environment.get(_LOCALHOST_ONLY) == "1":
            peers = []  # as in rcl
        addresses = ["127.0.0.1", *peers]
        builtin = _BUILTIN.format(peers="".join(_PEER.format(address=each) for each in addresses))
        interfaces = "" if peers else _INTERFACES
    return _PROFILE.format(
        buffer=BUFFER, participants=_participants(environment), interfaces=interfaces, builtin=builtin
    )


def on_this_machine(environment: Mapping[str, str]) -> bool:
    """Whether only nodes of this machine are discovered."""
    return environment.get(_RANGE) == "LOCALHOST" or environment.get(_LOCALHOST_ONLY) == "1"


def _participants(environment: Mapping[str, str]) -> int:
    """Participants of one machine that have ports in the domain, at most :data:`_PARTICIPANTS`.

    :raises Unavailable: it has none
    """
    try:
        domain = int(environment.get(_DOMAIN, ""))
    except ValueError:
        domain = 0  # rcl says what is wrong with it
    if not 0 <= domain <= _LAST_DOMAIN:
        raise Unavailable(f"{_DOMAIN} is {domain}; Fast DDS has ports for domains from 0 to {_LAST_DOMAIN}")
    # DDSI-RTPS 2.2, section 9.6.1.4: the second port of the first participant; each has two.
    first = 7400 + 250 * domain + 11
    return min(_PARTICIPANTS, (_LAST_PORT - first) // 2)


def _address(host: str) -> str:
    try:
        return socket.gethostbyname(host)
    except OSError as error:
        raise Unavailable(
            f"ROS_STATIC_PEERS names '{host}', which has no address: {error.strerror}"
        ) from error
