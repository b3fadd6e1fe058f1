"""The session of one client: dispatches each operation to its handler, limits rates, and ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol import rosbridge
from relay_protocol.errors import Refused
from relay_server.access import BadCredentials
from relay_server.common import close_codes
from relay_server.common.clock import Clock, PeriodicTimers
from relay_server.common.token_bucket import TokenBucket
from relay_server.sessions.context import ClientContext, LocalNode
from relay_server.sessions.goals import ActionGoalHandler
from relay_server.sessions.publishing import PublishHandler
from relay_server.sessions.service_calls import OfferedServiceHandler, ServiceCallHandler, is_stopping_call
from relay_server.sessions.subscriptions import SubscriptionHandler

CHANGES_A_SECOND = 50.0
CHANGES_AT_ONCE = 1000.0
"""Changes that one client may request; see ``_CHANGES``."""


class Session:
    """Carries out the operations of one client. Its answers go to the client's port.

    :param local: the relay's own services and topics
    :param on_end: called once, when it is over
    """

    log = Logger()

    __slots__ = (
        "_changes",
        "_on_end",
        "client",
        "closed",
        "goals",
        "offered_services",
        "publish_handler",
        "service_calls",
        "subscriptions",
    )

    def __init__(
        self,
        client: ClientContext,
        clock: Clock,
        local: LocalNode,
        timers: PeriodicTimers,
        on_end: Callable[[ClientContext], None],
    ) -> None:
        self.client = client
        self.closed = False
        self._on_end = on_end
        self._changes = TokenBucket(CHANGES_A_SECOND, CHANGES_AT_ONCE, clock.seconds)
        self.subscriptions = SubscriptionHandler(client, clock, local, timers)
        self.publish_handler = PublishHandler(client)
        self.service_calls = ServiceCallHandler(client, local)
        self.goals = ActionGoalHandler(client, local)
        self.offered_services = OfferedServiceHandler(client)
        client.close = client.quota.close = self.close
        client.recheck_rights = self.subscriptions.recheck_rights
        client.control_changed = self.publish_handler.control_changed
        client.permit.on_change = self._rights_changed
        client.permit.on_revoke = self._revoked

    def start(self) -> None:
        """Begin: attach the client to the robot's channel."""
        client = self.client
        client.channel.attach(client)
        self.log.info(
            "client {number}: {user} from {address} works with {robot}",
            number=client.number,
            user=client.permit.principal.full,
            address=client.address,
            robot=client.robot.full,
        )

    def end(self, *, orderly: bool = False) -> None:
        """The client is gone; release everything.

        :param orderly: the client has closed the connection
        """
        if self.closed:
            return
        self.closed = True
        client = self.client
        client.port.ended()
        # First of all, so that nothing of this client moves the robot any more.
        client.controller.client_left(client, orderly=orderly)
        self.subscriptions.end()
        self.service_calls.end()
        self.goals.end()
        client.channel.detach(client)
        self._on_end(client)

    def close(self, code: int, reason: str) -> None:
        """Close the connection with a code and a reason, and end."""
        if not self.closed:
            self.log.info("client {number} is cut: {reason}", number=self.client.number, reason=reason)
            self.client.port.disconnect(code, reason)
            self.end()

    def perform(self, operation: rosbridge.ClientOp) -> None:
        """Carry out an operation of the client; its processor time counts towards the user's quota.

        :raises Refused: the client has no right, or its quota is used up
        :raises SwitchboardError: it can't be done, with the reason
        """
        kind, quota = type(operation), self.client.quota
        if isinstance(operation, rosbridge.Publish):
            # Of Foxglove and of the relay's own clients; that of rosbridge goes straight to the handler.
            quota.check()
            self.publish_handler.publish(operation)
            return
        handler = _HANDLERS.get(kind)
        if handler is None:
            raise Refused(f"'{operation.__struct_config__.tag}' is not carried to robots by this relay")
        if kind in _CHANGES:
            self.count_change()
        if kind in _REFUSED_WHEN_BUSY and not is_stopping_call(operation):
            quota.check()
        with quota.timed():
            handler(self, operation)

    def call_own(self, service: str, args: dict[str, str]) -> Deferred[Any]:
        """Call one of the relay's own services with values; see :meth:`ServiceCallHandler.call_own`.

        :raises Refused: the user's CPU quota is used up
        """
        quota = self.client.quota
        quota.check()
        with quota.timed():
            return self.service_calls.call_own(service, args)

    def count_change(self) -> None:
        """:raises Refused: the client has requested too many changes"""
        if not self._changes.take():
            raise Refused(f"too many changes at once; at most {CHANGES_A_SECOND:g} a second are carried out")

    def _rights_changed(self) -> None:
        client = self.client
        self.subscriptions.recheck_rights()
        client.controller.rights_changed(client)
        self.service_calls.rights_changed()
        self.goals.rights_changed()
        client.channel.forget_denied(client, client.permit)
        client.port.rights_changed()

    def _revoked(self, error: Refused) -> None:
        code = close_codes.UNAUTHENTICATED if isinstance(error, BadCredentials) else close_codes.FORBIDDEN
        self.close(code, str(error))


_REFUSED_WHEN_BUSY = {
    rosbridge.Subscribe,
    rosbridge.Advertise,
    rosbridge.AdvertiseService,
    rosbridge.AdvertiseAction,
    rosbridge.CallService,
    rosbridge.SendActionGoal,
}
"""Operations that cause work. Those that withdraw, cancel or answer are always carried out."""

_CHANGES = {
    rosbridge.Subscribe,
    rosbridge.Advertise,
    rosbridge.AdvertiseService,
    rosbridge.AdvertiseAction,
}
"""Operations whose rate is limited. Messages and calls are not counted, nor what withdraws: what stays would count."""

_HANDLERS: dict[type, Callable[[Session, Any], None]] = {
    rosbridge.Subscribe: lambda session, operation: session.subscriptions.subscribe(operation),
    rosbridge.Unsubscribe: lambda session, operation: session.subscriptions.unsubscribe(operation),
    rosbridge.Advertise: lambda session, operation: session.publish_handler.advertise(operation),
    rosbridge.Unadvertise: lambda session, operation: session.publish_handler.unadvertise(operation),
    rosbridge.CallService: lambda session, operation: session.service_calls.call(operation),
    rosbridge.AdvertiseService: lambda session, operation: session.offered_services.advertise_service(
        operation
    ),
    rosbridge.UnadvertiseService: lambda session, operation: session.offered_services.unadvertise_service(
        operation
    ),
    rosbridge.ServiceResponse: lambda session, operation: session.offered_services.service_response(
        operation
    ),
    rosbridge.AdvertiseAction: lambda session, operation: session.offered_services.advertise_action(
        operation
    ),
    rosbridge.UnadvertiseAction: lambda session, operation: session.offered_services.unadvertise_action(
        operation
    ),
    rosbridge.ActionFeedback: lambda session, operation: session.offered_services.action_feedback(operation),
    rosbridge.ActionResult: lambda session, operation: session.offered_services.action_result(operation),
    rosbridge.SendActionGoal: lambda session, operation: session.goals.send_goal(operation),
    rosbridge.CancelActionGoal: lambda session, operation: session.goals.cancel(operation),
}
"""Handlers of all operations but ``publish``, which :meth:`Session.perform` dispatches first."""
