"""Makes the ROS participant again after the machine's addresses have changed.

A participant of Fast DDS listens at the addresses of its start (Fast-DDS#6055). When all of them are gone, nodes of one
machine that found each other before go on, but a node that starts afterwards and they never find each other. So the
daemon stays with those that run, and follows to the new addresses when none of them is left.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from robot_client.addresses import finds_others, own_addresses
from robot_client.alerts import MODULE, AlertCondition, OnAlert, ignore_alert

_MADE_AGAIN = (
    "until the daemon's nodes are made again; that is done when the robot stands still and has nothing to do"
)
_LEFT = (
    "by those that run, nor by the daemon, since no former address is left. Start the robot's ROS nodes again; once "
    "none of the former runs, the daemon makes its own again and finds the new ones"
)


class RenewableRobot(Protocol):
    """The robot's daemon, as far as its participant is made again."""

    @property
    def is_idle(self) -> bool:
        """Whether the robot stands still, and no call or goal is under way."""

    @property
    def nodes(self) -> frozenset[str]:
        """Full names of the ROS nodes in the graph, without the daemon's."""

    def release_platform(self, reason: str) -> Deferred[object]:
        """End what uses the platform; fires when the platform can be made again. The relay opens it again later."""

    def renew_platform(self, reason: str) -> None:
        """Make the platform again, and what else has a ROS node.

        :raises Exception: that failed
        """


class AddressChanges:
    """Watches the addresses; :meth:`check` is called every :data:`robot_client.addresses.CHECK_SECONDS`.

    A change counts when two looks agree, and so does standing still.

    :param read: the addresses now
    :param alert: reports that nodes are not found until people start the robot's nodes again
    """

    def __init__(
        self,
        robot: RenewableRobot,
        read: Callable[[], frozenset[str]] = own_addresses,
        alert: OnAlert = ignore_alert,
    ) -> None:
        self._robot = robot
        self._read = read
        self._known = self._latest = read()
        self._announced: frozenset[str] | None = None
        """The addresses of the change that was logged."""
        self._was_idle = False
        self._under_way = False
        self._log = Logger("network")
        self._lost = AlertCondition(alert, MODULE, "addresses")

    def check(self) -> None:
        """Make the participant again if the addresses have changed and the robot stands still."""
        before, self._latest = self._latest, self._read()
        if self._under_way or not self._latest or self._latest != before:
            return
        if self._latest == self._known:
            self._announced = None
            self._lost.update("", "the machine has its former addresses again, and ROS nodes are found")
            return
        if self._announced != self._latest:
            self._announced = self._latest
            self._was_idle = False
            self._announce()
        idle = self._robot.is_idle and finds_others(self._known, self._latest, self._robot.nodes)
        if idle and self._was_idle:
            self._renew()
        self._was_idle = idle

    def _announce(self) -> None:
        words = (
            f"the machine's addresses have changed ({self._change()}). ROS nodes that start now are not found"
        )
        if finds_others(self._known, self._latest, self._robot.nodes):
            self._log.warn("{words} {until}", words=words, until=_MADE_AGAIN)
        else:
            self._lost.update(f"{words} {_LEFT}", "")

    def _change(self) -> str:
        words = (("new", self._latest - self._known), ("gone", self._known - self._latest))
        return "; ".join(f"{word}: {', '.join(sorted(each))}" for word, each in words if each)

    def _renew(self) -> None:
        self._under_way = True
        reason = "the machine's addresses have changed"
        released = self._robot.release_platform(reason)
        released.addCallback(lambda _: self._renew_now(reason))
        released.addErrback(
            lambda failure: self._log.failure(
                "the daemon's ROS nodes could not be made again; it is tried again", failure
            )
        )
        released.addBoth(self._ended)

    def _renew_now(self, reason: str) -> None:
        addresses = self._read()
        self._robot.renew_platform(reason)
        self._known = addresses
        self._log.info("the daemon's ROS nodes were made again: {reason}", reason=reason)
        self._lost.update("", "ROS nodes are found at the machine's new addresses")

    def _ended(self, result: object) -> None:
        self._under_way = self._was_idle = False
