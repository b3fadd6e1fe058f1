"""``/relay/…`` about control: taking it and giving it back, stopping the robot, suppressing and inhibiting topics."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from relay_protocol.errors import Invalid, Refused, SwitchboardError, Unavailable
from relay_protocol.rights import Operation
from relay_server.channels.robot_link import resolve
from relay_server.control import view
from relay_server.control.audit import reason_of
from relay_server.control.commands import NotDone
from relay_server.control.types import ControlReply, actor_of
from relay_server.relay_node.arguments import get_argument, text
from relay_server.sessions.session import Session


async def take_control(session: Session, args: Any) -> Any:
    """``/relay/take_control``"""
    return (await session.desk.take(session, _why(args)))._asdict()


async def release_control(session: Session, args: Any) -> Any:
    """``/relay/release_control``"""
    return session.desk.release(session, _why(args))._asdict()


async def grant_control(session: Session, args: Any) -> Any:
    """``/relay/grant_control``"""
    return session.desk.grant(session, _why(args), _number(args, "client", 1, 0))._asdict()


async def refuse_control(session: Session, args: Any) -> Any:
    """``/relay/refuse_control``"""
    return session.desk.refuse(session, _why(args), _number(args, "client", 1, 0))._asdict()


async def stop(session: Session, args: Any) -> Any:
    """``/relay/stop``: for everybody with a right on the robot, which is who has a session.

    ``done`` tells whether the robot has done it; where it has not, and it is no failure, it will when it is back.
    """
    name = session.robot.name
    try:
        done = await session.desk.stopping.stop(actor_of(session), reason_of(get_argument(args, "why")))
    except (NotDone, Unavailable) as error:
        return {**ControlReply(False, str(error))._asdict(), "done": False}
    finally:
        # Who has the answer may resume at once.
        session.ping()
    said = (
        f"robot {name} is stopped" if done else f"robot {name} will be stopped as soon as it can be reached"
    )
    return {**ControlReply(True, said)._asdict(), "done": done}


async def resume(session: Session, args: Any) -> Any:
    """``/relay/resume``: what can have been sent before the robot was last stopped does not let it move."""
    if not session.desk.may_resume(session):
        raise Refused("only who has control of the robot, and its owners, may resume it")
    await session.desk.stopping.resume(actor_of(session), _why(args), session.not_before)
    return ControlReply(True, f"robot {session.robot.name} may move again")._asdict()


async def suppress(session: Session, args: Any) -> Any:
    """``/relay/suppress``"""
    resource, ms = resolve(text(args, "resource")), _number(args, "ms", 1, 100)
    session.judge(Operation.SUPPRESS, resource)
    await session.desk.subsuming.suppress(actor_of(session), [session.number], resource, ms)
    return ControlReply(
        True, f"{resource} obeys you for {ms} ms" if ms else f"{resource} is not suppressed"
    )._asdict()


async def inhibit(session: Session, args: Any) -> Any:
    """``/relay/inhibit``"""
    resource, ms = resolve(text(args, "resource")), _number(args, "ms", 1, 1000)
    hold = get_argument(args, "hold", 2, False)
    if not isinstance(hold, bool):
        raise Invalid("'hold' must be true or false")
    session.judge(Operation.INHIBIT, resource)
    await session.desk.subsuming.inhibit(actor_of(session), resource, ms, hold, session)
    return ControlReply(
        True, f"{resource} is inhibited for {ms} ms" if ms else f"{resource} is not inhibited"
    )._asdict()


def told(session: Session) -> dict[str, Any]:
    """``/relay/control``: who moves the robot, for the one who asks."""
    asker = view.ControlReader(session.permit.rules, lambda client: client is session)
    return view.control(session.desk, asker, session.number)


def _in_words(
    service: Callable[[Session, Any], Awaitable[Any]],
) -> Callable[[Session, Any], Awaitable[Any]]:
    """What could not be done is an answer like others; what may not be done or makes no sense fails the call."""

    async def answered(session: Session, args: Any) -> Any:
        try:
            return await service(session, args)
        except (Refused, Invalid):
            raise
        except SwitchboardError as error:
            return ControlReply(False, str(error))._asdict()

    return answered


def _number(args: Any, field: str, position: int, default: int) -> int:
    value = get_argument(args, field, position, default)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool):
        raise Invalid(f"'{field}' must be a whole number")
    return value


def _why(args: Any) -> str:
    return text(args, "why", default="")


SERVICES: dict[str, Callable[[Session, Any], Awaitable[Any]]] = {
    f"/relay/{handler.__name__}": _in_words(handler)
    for handler in (
        take_control,
        release_control,
        grant_control,
        refuse_control,
        stop,
        resume,
        suppress,
        inhibit,
    )
}
