"""Maximum ages: requests that move the robot have a deadline, all others have none."""

from __future__ import annotations

import base64
import contextlib
import time
from fnmatch import fnmatchcase
from typing import Any

from conformance_suite import case, not_offered
from link_relay import Link, LinkRelay
from robot_tasks import CDR, DRIVER, FIBONACCI, TRIGGER, fibonacci, service


def motion(relay: LinkRelay) -> dict[str, Any]:
    """What the robot counts as motion."""
    return dict(relay.facts().get("motion", {}))


def long_ago() -> int:
    """A stamp of long before any deadline."""
    return time.monotonic_ns() // 2


def counted(control: Link, what: str) -> int:
    """A counter of dropped requests, in the second message about health from now on."""
    with contextlib.suppress(AssertionError):
        while True:
            control.expect("health", 0.0)
    control.expect("health", 20)
    return int(control.expect("health", 20).get(what, 0))


def moving_action(relay: LinkRelay) -> str:
    """The name of an action that counts as motion; it need not exist."""
    plain = [each.replace("*", "") for each in motion(relay).get("actions", []) if not set("?[") & set(each)]
    if not plain:
        not_offered("no action that counts as motion")
    return plain[0]


def never_begins(channel: Link, action: str, stamp: int) -> None:
    """The holder's goal with this stamp is refused with a reason."""
    channel.say(
        "send_action_goal",
        id="old",
        action=action,
        type=FIBONACCI,
        source=DRIVER,
        stamp=stamp,
        cdr=base64.b64encode(CDR + bytes(4)).decode(),
        args={},
    )
    end = channel.expect("action_result", id="old")
    assert (end["status"], end["result"]) == (0, False)
    assert end["reason"]


@case("send_action_goal", "SPEC 2.5-31")
def test_old_goal_that_moves(relay: LinkRelay, channel: Link) -> None:
    """The holder's goal for what counts as motion never begins when its stamp is too old, and is counted."""
    action, control = moving_action(relay), relay.control
    assert control.order("resume", by="the suite").get("ok", True)
    assert control.order("control_grant", holder=DRIVER, user="the suite", level="operator").get("ok", True)
    before = counted(control, "stale_commands")
    deadline = motion(relay).get("deadline_ms", 500) * 1_000_000
    never_begins(channel, action, time.monotonic_ns() - deadline - 50_000_000)
    assert counted(control, "stale_commands") == before + 1


@case("send_action_goal", "SPEC 2.5-52")
def test_goal_sent_before_the_resume(relay: LinkRelay, channel: Link) -> None:
    """The holder's goal for what counts as motion never begins when it was sent before the resume, and is counted."""
    action, control = moving_action(relay), relay.control
    assert control.order("control_grant", holder=DRIVER, user="the suite", level="operator").get("ok", True)
    before = counted(control, "refused_commands")
    assert control.order("stop", by="the suite").get("ok", True)
    stamp = time.monotonic_ns()
    assert control.order("resume", by="the suite").get("ok", True)
    never_begins(channel, action, stamp)
    assert counted(control, "refused_commands") == before + 1


@case("send_action_goal", "SPEC 2.5-31")
def test_old_goal_that_moves_nothing(relay: LinkRelay, channel: Link) -> None:
    """A goal for what does not count as motion is executed for any age of its stamp."""
    fibonacci(relay, channel, 3, stamp=long_ago())
    assert channel.expect("action_result", id="g")["status"] == 4


@case("call_service", "SPEC 2.5-31")
def test_old_call_that_moves_nothing(relay: LinkRelay, channel: Link) -> None:
    """A call of what does not count as motion is made for any age of its stamp."""
    name = service(relay)
    if any(fnmatchcase(name, each) for each in motion(relay).get("services", [])):
        not_offered(f"{name} counts as motion")
    cdr = "cdr" in relay.hello["encodings"]
    args = {"cdr": base64.b64encode(CDR + b"\0").decode()} if cdr else {"args": {}}
    channel.say("call_service", id="old", service=name, type=TRIGGER, timeout=5, stamp=long_ago(), **args)
    assert channel.expect("service_response", id="old")["result"] is True
