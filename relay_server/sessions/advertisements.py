"""Services and actions a client offers to the robot's graph, and its answers to what it is asked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from relay_protocol import rosbridge
from relay_protocol.rights import Operation
from relay_server.channels.robot_link import resolve
from relay_server.sessions.type_names import normal_type

if TYPE_CHECKING:
    from relay_server.sessions.session import Session


class AdvertisementHandler:
    """What one session offers. Who calls it is judged where the call comes in."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def advertise_service(self, ask: rosbridge.AdvertiseService) -> None:
        """The client offers a service."""
        session, name = self._session, resolve(ask.service)
        session.judge(Operation.PROVIDE, name)
        session.channel.services.advertise(
            session, name, ask.service, normal_type(ask.type, "srv"), ask.type, ask.id
        )

    def unadvertise_service(self, ask: rosbridge.UnadvertiseService) -> None:
        """The client takes its service back."""
        self._session.channel.services.unadvertise(self._session, resolve(ask.service))

    def service_response(self, answer: rosbridge.ServiceResponse) -> None:
        """The client answers a call."""
        self._session.channel.served.answered(self._session, answer)

    def advertise_action(self, ask: rosbridge.AdvertiseAction) -> None:
        """The client offers an action."""
        session, name = self._session, resolve(ask.action)
        session.judge(Operation.PROVIDE, name)
        session.channel.actions.advertise(
            session, name, ask.action, normal_type(ask.type, "action"), ask.type, ask.id
        )

    def unadvertise_action(self, ask: rosbridge.UnadvertiseAction) -> None:
        """The client takes its action back."""
        self._session.channel.actions.unadvertise(self._session, resolve(ask.action))

    def action_feedback(self, message: rosbridge.ActionFeedback) -> None:
        """The client tells how far it has come with a goal."""
        self._session.channel.goals.client_feedback(self._session, message)

    def action_result(self, message: rosbridge.ActionResult) -> None:
        """The client is done with a goal."""
        self._session.channel.goals.client_result(self._session, message)
