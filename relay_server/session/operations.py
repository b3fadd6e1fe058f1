"""Which desk of a session does what a client asks for, what of it is bounded, and what has to be answered."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import Refused
from relay_server.channel.goal import Status
from relay_server.session.calling import is_urgent

if TYPE_CHECKING:
    from relay_server.session.core import Session

_REFUSED_WHEN_BUSY = {
    rosbridge.Subscribe,
    rosbridge.Advertise,
    rosbridge.AdvertiseService,
    rosbridge.AdvertiseAction,
    rosbridge.CallService,
    rosbridge.SendActionGoal,
}
"""What asks for work. What takes back, cancels or answers is always done."""

_CHANGES = {
    rosbridge.Subscribe,
    rosbridge.Unsubscribe,
    rosbridge.Advertise,
    rosbridge.Unadvertise,
    rosbridge.AdvertiseService,
    rosbridge.UnadvertiseService,
    rosbridge.AdvertiseAction,
    rosbridge.UnadvertiseAction,
    rosbridge.SetLevel,
}
"""What one client may ask for only so many times. Messages and calls are not counted."""

CHANGES_A_SECOND = 50.0
CHANGES_AT_ONCE = 1000.0


def _auth(session: Session, ask: rosbridge.Auth) -> None:
    """Authenticated already; rosauth clients send it on every connection."""


_HANDLERS: dict[type, Callable[[Session, Any], None]] = {
    rosbridge.Subscribe: lambda session, ask: session.listening.subscribe(ask),
    rosbridge.Unsubscribe: lambda session, ask: session.listening.unsubscribe(ask),
    rosbridge.Advertise: lambda session, ask: session.publishing.advertise(ask),
    rosbridge.Unadvertise: lambda session, ask: session.publishing.unadvertise(ask),
    rosbridge.CallService: lambda session, ask: session.calling.call(ask),
    rosbridge.AdvertiseService: lambda session, ask: session.providing.advertise_service(ask),
    rosbridge.UnadvertiseService: lambda session, ask: session.providing.unadvertise_service(ask),
    rosbridge.ServiceResponse: lambda session, ask: session.providing.service_response(ask),
    rosbridge.AdvertiseAction: lambda session, ask: session.providing.advertise_action(ask),
    rosbridge.UnadvertiseAction: lambda session, ask: session.providing.unadvertise_action(ask),
    rosbridge.ActionFeedback: lambda session, ask: session.providing.action_feedback(ask),
    rosbridge.ActionResult: lambda session, ask: session.providing.action_result(ask),
    rosbridge.SendActionGoal: lambda session, ask: session.pursuing.send_goal(ask),
    rosbridge.CancelActionGoal: lambda session, ask: session.pursuing.cancel(ask),
    rosbridge.Fragment: lambda session, part: session.incoming.take(part),
    rosbridge.SetLevel: lambda session, ask: session.set_level(ask),
    rosbridge.Auth: _auth,
}
"""All but ``publish``, which is nearly all that clients send and takes a shorter way."""


def perform(session: Session, operation: rosbridge.ClientOp) -> None:
    """Have the desk that is concerned do what the client asks for, on the user's account.

    :raises Refused: there is none, it is too much at once, or the desk says so
    :raises SwitchboardError: whatever else keeps the desk from doing it
    """
    kind = type(operation)
    handler = _HANDLERS.get(kind)
    if handler is None:
        raise Refused(f"'{operation.__struct_config__.tag}' is not carried to robots by this relay")
    if kind in _CHANGES and not session.changes.take():
        raise Refused(f"too many changes at once; at most {CHANGES_A_SECOND:g} a second are followed")
    if kind in _REFUSED_WHEN_BUSY and not is_urgent(operation):
        session.share.check()
    with session.share.timed():
        handler(session, operation)


def answer_failed(session: Session, operation: rosbridge.ClientOp, error: Exception) -> None:
    """Answer what has to be answered, with the reason why it is not done; nobody may wait in vain."""
    if isinstance(operation, rosbridge.CallService):
        session.calling.answer(operation, False, jsontext.encode(str(error)))
    elif isinstance(operation, rosbridge.SendActionGoal):
        session.pursuing.answer(operation, Status.NEVER_BEGAN, False, jsontext.encode(str(error)))
