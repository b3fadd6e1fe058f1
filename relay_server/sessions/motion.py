"""Calls and goals that move the robot: they take control of it, and have the deadline of commands."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from relay_server.sessions.session import Session


class MotionRequest:
    """One call or goal of a client that moves the robot; see
    :class:`relay_server.channels.robot_link.MotionRequestPort`.

    :param what: it is, for people
    :param stamp: the relay's monotonic nanoseconds before which it can't have been sent
    :raises Refused: it may be too old, somebody else has control, or it must be taken first
    """

    def __init__(self, session: Session, what: str, stamp: int) -> None:
        self._session = session
        self._what = what
        self._stamp = stamp
        # What is too old must not even take control.
        self.judge()
        session.desk.claim(session)
        session.publishing.commands()

    async def controls(self) -> None:
        """Wait until the client controls the robot.

        :raises Refused: as above
        :raises Unavailable: the robot is offline, or does not agree
        """
        self.judge()
        await self._session.desk.claimed(self._session)

    def judge(self) -> None:
        """See that it is not too old by now.

        :raises Refused: it may be
        """
        self._session.publishing.judge_age(self._what, self._stamp)
