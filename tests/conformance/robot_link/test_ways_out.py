"""The end of a link, and the robot's reconnection. Each case costs the robot its link."""

from __future__ import annotations

import contextlib
import struct
import time

import pytest
from conformance_suite import case
from link_relay import HEARTBEAT, JSON, PATIENCE, RARE, RELAY_JSON_FRAME, Link, LinkRelay, frame, message
from robot_tasks import subscribe


@case("bye", "SPEC 2.3 bye")
def test_bye(relay: LinkRelay) -> None:
    """After bye the robot hangs up, and dials again."""
    link = relay.control
    link.say("bye", reason="a case of the conformance suite")
    link.wait_end()
    assert not relay.control.ended


@case("reconnect", "SPEC 2.3, dials again, for ever")
def test_cut(relay: LinkRelay) -> None:
    """After the link was cut the robot connects again, proves its key again, and sends its description again."""
    relay.control.cut()
    assert not relay.control.ended
    assert relay.first_graph is not None
    with relay.channel() as link:
        subscribe(link, relay)
        link.expect_sample(7)


@case("reconnect", "SPEC 2.3, nothing for three heartbeats")
def test_silent_relay(relay: LinkRelay) -> None:
    """A relay that is silent for three heartbeats is disconnected, and dialled again."""
    link = relay.control_with(HEARTBEAT)
    link.answers_pings = False
    link.wait_end()
    assert not relay.control.ended


@case("reconnect", "SPEC 2.3, with growing random delays")
def test_backoff(relay: LinkRelay) -> None:
    """A relay that hangs up at once is dialled again, but not in a tight loop."""
    relay.control.cut()
    before, until = relay.dials, time.monotonic() + 1.5
    while time.monotonic() < until:
        with contextlib.suppress(AssertionError):
            relay.dialled("hello", 0.05)[0].cut()
    assert relay.dials - before < 20
    assert not relay.control.ended


@case("refused", "SPEC 2.2 refused, retry_after")
def test_refused(relay: LinkRelay) -> None:
    """A robot that is refused with retry_after hangs up, and dials again."""
    relay.control.cut()
    link, _ = relay.dialled("hello", relay.patience)
    link.say("refused", reason="a case of the conformance suite", code="unavailable", retry_after=0.2)
    link.wait_end()
    assert not relay.control.ended


def breaks(link: Link, data: bytes, seconds: float = PATIENCE) -> None:
    """After these bytes the robot sends an error or nothing, and disconnects earlier than after silence."""
    link.raw(data)
    link.wait_end(seconds)


@case("frames", "SPEC 2.1, a length over the limit")
def test_oversized_frame(relay: LinkRelay) -> None:
    """A frame over 4 MiB is refused by its length, and the robot dials again."""
    breaks(relay.control_with(RARE), struct.pack("!IB", RELAY_JSON_FRAME + 1, JSON))
    assert not relay.control.ended


@case("frames", "SPEC 2.1, 16 KiB until the robot is proved")
def test_oversized_before_proof(relay: LinkRelay) -> None:
    """Before the proof a frame over 16 KiB is refused."""
    relay.control.cut()
    link, _ = relay.dialled("hello", relay.patience)
    # Before it gets another heartbeat, a robot waits for 6 s of silence.
    breaks(link, struct.pack("!IB", 16 * 1024 + 1, JSON), 4)
    assert not relay.control.ended


@case("frames", "SPEC 2.1, breaks the contract")
@pytest.mark.parametrize(
    "data",
    [struct.pack("!I", 0), frame(77, b"?"), frame(JSON, b"no JSON"), frame(JSON, b"[]"), frame(1, b"short")],
    ids=["length 0", "unknown kind", "no JSON", "no object", "a sample on the control link"],
)
def test_broken_frames(relay: LinkRelay, data: bytes) -> None:
    """A violation of the contract ends the link, and the robot dials again."""
    breaks(relay.control_with(RARE), data + b"\0\0")
    assert not relay.control.ended


@case("frames", "SPEC 2.2, an unknown op")
def test_unknown_op(relay: LinkRelay) -> None:
    """An unknown op on the control link ends it, and the robot dials again."""
    breaks(relay.control_with(RARE), message("make_coffee"))
    assert not relay.control.ended


@case("frames", "SPEC 2.2, an unknown op")
def test_unknown_op_on_channel(relay: LinkRelay) -> None:
    """An unknown op on a channel link gets an error or ends it; the control link lives."""
    control = relay.control
    with relay.channel() as link:
        link.say("make_coffee")
        with contextlib.suppress(AssertionError):
            assert link.expect("failed", 1)["reason"]
            return
        link.wait_end()
    control.say("ping", t=1)
    control.expect("pong", t=1)
