"""How the daemon, its guard and its camera process talk to the robot's graph: by UDP alone where it is of Fast DDS.

Fast DDS prefers shared memory between processes of one machine. Whoever sends there takes a lock in the memory of the
one who listens, and waits up to a second, again and again, when a listener that was stopped in the wrong moment holds
it (Fast DDS 2.14: one freeze in 30 at 2,000 messages per second); who meets it anew waits for thirds of a second until
it shows that it lives. A robot's base that publishes its odometry would be held up by a daemon that is frozen, and
would not hear the guard's stop meanwhile. Nobody waits for a UDP socket.
"""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from relay_protocol.errors import Unavailable

_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Where Fast DDS 2 and 3 find their settings."""

_CHOSEN = (*_PROFILES, "FASTDDS_BUILTIN_TRANSPORTS")
"""Settings by which somebody has chosen the transports of this robot; they stand."""

_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_LOCALHOST_ONLY = "ROS_LOCALHOST_ONLY"
_PEERS = "ROS_STATIC_PEERS"

BUFFER = 4 * 1024 * 1024
"""Bytes asked of the system for what waits to be read: some large pictures. ``net.core.rmem_max`` may allow less."""

_PARTICIPANTS = 100
"""Participants of one machine that are looked for, of the 120 that have ports in a domain (DDSI-RTPS 9.6.1.1)."""

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
    """Nodes that are made meanwhile, the first of a process, share no memory with others.

    :param middleware: what ``rclpy.get_rmw_implementation_identifier`` says
    :raises Unavailable: ``ROS_STATIC_PEERS`` names a host that nobody knows
    """
    if not middleware.startswith("rmw_fastrtps") or any(os.environ.get(each) for each in _CHOSEN):
        yield
        return
    with tempfile.TemporaryDirectory(prefix="switchboard-dds-") as folder:
        file = Path(folder, "udp.xml")
        file.write_text(profile(os.environ), encoding="utf-8")
        before = dict(os.environ)
        os.environ.update(dict.fromkeys(_PROFILES, str(file)))
        if _on_this_machine(before):
            # Told to stay on this machine, rmw_fastrtps sets transports of its own, shared memory among them.
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
    """Settings for Fast DDS (its XML profiles) that do what the environment asks of ROS 2, by UDP.

    :raises Unavailable: ``ROS_STATIC_PEERS`` names a host that nobody knows
    """
    interfaces = builtin = ""
    if _on_this_machine(environment):
        peers = [_address(each.strip()) for each in environment.get(_PEERS, "").split(";") if each.strip()]
        if environment.get(_LOCALHOST_ONLY) == "1":
            peers = []  # as rcl has it
        addresses = ["127.0.0.1", *peers]
        builtin = _BUILTIN.format(peers="".join(_PEER.format(address=each) for each in addresses))
        interfaces = "" if peers else _INTERFACES
    return _PROFILE.format(buffer=BUFFER, participants=_PARTICIPANTS, interfaces=interfaces, builtin=builtin)


def _on_this_machine(environment: Mapping[str, str]) -> bool:
    return environment.get(_RANGE) == "LOCALHOST" or environment.get(_LOCALHOST_ONLY) == "1"


def _address(host: str) -> str:
    try:
        return socket.gethostbyname(host)
    except OSError as error:
        raise Unavailable(
            f"ROS_STATIC_PEERS names '{host}', which has no address: {error.strerror}"
        ) from error
