"""The originator of a request about control, by whatever path it arrives; the event log and the audit log name it."""

from __future__ import annotations

from typing import NamedTuple

from relay_server.control.lease import LeaseClient


class Actor(NamedTuple):
    """The originator of a request about control.

    :param name: the display name
    :param source: for the record: ``user:ann``, ``cli:root``, ``relay``
    :param user: the user's id, ``None`` for other originators
    :param connection: number of the session that sent it, 0 for none
    """

    name: str
    source: str
    user: int | None = None
    address: str = ""
    connection: int = 0


def actor_of(client: LeaseClient) -> Actor:
    """A client as the originator of a request."""
    return user_actor(client.name, client.user, client.address, client.number)


def user_actor(name: str, user: int, address: str, connection: int = 0) -> Actor:
    """A user.

    :param name: at the robot, see :meth:`relay_server.robots.registry.RobotState.name_of`
    :param user: the user's id
    :param connection: number of the session that sent the request, 0 for none
    """
    return Actor(name, f"user:{name}", user, address, connection)


def local_actor(by: str) -> Actor:
    """A user of the relay's own machine.

    :param by: name of the operating system's user
    """
    return Actor(by, f"cli:{by}", address="local")
