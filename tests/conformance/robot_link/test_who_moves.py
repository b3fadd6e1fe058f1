"""Control of the robot: orders, and sources whose commands are obeyed."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from conformance_suite import case
from link_relay import PATIENCE, Link, LinkRelay
from robot_tasks import DRIVER, Wheels, sensor, subscribe

OTHER = DRIVER + 1


@pytest.fixture
def control(relay: LinkRelay) -> Iterator[Link]:
    """The control link of a robot that is not stopped, before and after."""
    link = relay.control
    assert link.order("resume", by="the suite").get("ok", True)
    yield link
    if not link.ended:
        assert link.order("resume", by="the suite").get("ok", True)


@case("control", "SPEC 2.4 commands, order_result, motion_state")
def test_orders_are_answered(control: Link) -> None:
    """Each order is answered by done with its id, and safety reports its changes."""
    assert control.order("control_grant", holder=0).get("ok", True)
    assert control.order("control_grant", holder=DRIVER, user="ann", level="operator", why="asked").get(
        "ok", True
    )
    control.expect("motion_state", holder=DRIVER)
    assert control.order("stop", by="eve", why="a case").get("ok", True)
    while True:
        stopped = control.expect("motion_state").get("stopped")
        if stopped:
            break
    assert (stopped["by"], stopped.get("why", "")) == ("eve", "a case")
    assert abs(stopped["since"] - time.time()) < 86_400
    assert control.order("resume", by="ann").get("ok", True)
    while control.expect("motion_state").get("stopped"):
        pass


@case("control", "SPEC 2.4 suppress, inhibit")
def test_orders_about_nothing(control: Link) -> None:
    """A topic that does not exist can be neither suppressed nor inhibited: ok is false, with a reason."""
    for op in ("suppress", "inhibit"):
        done = control.order(op, resource="/no/such/topic_of_any_robot", ms=100)
        assert done["ok"] is False
        assert done["reason"]


@case("safety", "SPEC 2.4 motion_state, 2.5-39")
def test_safety_after_welcome(relay: LinkRelay) -> None:
    """safety comes after welcome, and there is no holder then."""
    relay.control.order("control_grant", holder=DRIVER)
    relay.control.cut()
    assert relay.control.expect("motion_state").get("holder", 0) == 0


@case("inhibit", "SPEC 2.5-50")
def test_inhibit(relay: LinkRelay, control: Link, channel: Link) -> None:
    """An inhibited topic sends nothing for its time, and then continues."""
    topic, _ = sensor(relay)
    subscribe(channel, relay)
    channel.expect_sample(7)
    assert control.order("inhibit", resource=topic, ms=2000).get("ok", True)
    channel.no_sample(7)
    channel.expect_sample(7)


@case("inhibit", "SPEC 2.5-50")
def test_hold(relay: LinkRelay, control: Link, channel: Link) -> None:
    """With hold its last value replaces new ones; ms of 0 ends it."""
    topic, _ = sensor(relay)
    subscribe(channel, relay)
    channel.expect_sample(7)
    assert control.order("inhibit", resource=topic, ms=5000, hold=True).get("ok", True)
    until, before = time.monotonic() + PATIENCE, b""
    # Messages under way come first; a sensor whose value is not held never has one twice.
    while (held := channel.expect_sample(7).body) != before:
        assert time.monotonic() < until, "its values go on"
        before = held
    assert {channel.expect_sample(7).body for _ in range(3)} == {held}
    assert control.order("inhibit", resource=topic).get("ok", True)


@case("control", "SPEC 2.5-38")
def test_only_the_holder(drive: Wheels) -> None:
    """Commands of sources without control are dropped, also without a holder; the holder's are obeyed."""
    drive.stands(drive.start())
    for _ in range(5):
        drive.command(0.3, source=OTHER)
    drive.never_moves()
    drive.give(0)
    for source in (0, DRIVER):
        drive.command(0.3, source=source)
    drive.never_moves()
    drive.give(DRIVER)
    drive.start()


@case("control", "SPEC 2.5-38")
def test_samples_are_no_commands(drive: Wheels) -> None:
    """A sample to what moves it is dropped, also while the holder drives."""
    drive.stands(drive.start())
    for _ in range(5):
        drive.driving.sample(2, drive.twist(0.3))
    drive.never_moves()
    drive.start()


@case("control", "SPEC 2.5-39")
def test_another_holder(drive: Wheels) -> None:
    """A change of control stops motion at once, and from then on only the new holder is obeyed."""
    moving = drive.start()
    drive.give(OTHER)
    assert drive.stands(moving) < 0.6 * drive.stop_within
    for _ in range(5):
        drive.command(0.3)
    drive.never_moves()
    drive.start(OTHER)


@case("control", "SPEC 2.5-39")
def test_same_holder(drive: Wheels) -> None:
    """Control given to the present holder does not stop the robot."""
    drive.start()
    for _ in range(5):
        drive.give(DRIVER)
        drive.command(0.2)
        assert drive.next_speed(0.1) in (0.2, None)


@case("stop", "SPEC 2.5-41")
def test_stop(drive: Wheels) -> None:
    """stop is zero at once; the holder's commands after it move nothing."""
    moving = drive.start()
    assert drive.control.order("stop", by="eve").get("ok", True)
    assert drive.stands(moving) < 0.6 * drive.stop_within
    drive.streams(0.2, 0.6)
    drive.never_moves()


@case("stop", "SPEC 2.5-41")
def test_stop_outlives_the_link(relay: LinkRelay, drive: Wheels) -> None:
    """A robot that was stopped reports it when it is back, and obeys no source."""
    drive.start()
    assert drive.control.order("stop", by="eve").get("ok", True)
    relay.control.cut()
    control = relay.control
    assert control.expect("motion_state")["stopped"]["by"] == "eve"
    assert control.order("control_grant", holder=DRIVER).get("ok", True)
    with relay.channel() as watching, relay.channel() as driving:
        again = Wheels(relay, driving, watching, resume=False)
        again.streams(0.2, 0.6)
        again.never_moves()
        again.resume()
        again.start()


@case("resume", "SPEC 2.5-44")
def test_resume_moves_nothing(drive: Wheels) -> None:
    """A source that commands through stop and resume is not obeyed until a pause of 500 ms."""
    moving = drive.start()
    assert drive.control.order("stop", by="eve").get("ok", True)
    drive.stands(moving)
    drive.streams(0.2, 0.3)
    drive.resume()
    drive.streams(0.2, 1.0)
    time.sleep(0.8)  # a pause that counts as a release, for any uncertainty of the ping
    until = time.monotonic() + PATIENCE
    while drive.next_speed(0.05) != 0.2:
        assert time.monotonic() < until, "it does not move after he let go"
        drive.command(0.2)


@case("resume", "SPEC 2.5-44")
def test_zero_is_a_release(drive: Wheels) -> None:
    """After the resume one command of zero is enough."""
    moving = drive.start()
    assert drive.control.order("stop", by="eve").get("ok", True)
    drive.stands(moving)
    drive.streams(0.2, 0.2)
    drive.resume()
    drive.streams(0.2, 0.2)
    drive.start()


@case("resume", "SPEC 2.5-52")
def test_sent_before_the_resume(drive: Wheels) -> None:
    """Commands that may have been sent before the resume are not obeyed after it, even after a zero of their
    source.
    """
    moving = drive.start()
    assert drive.control.order("stop", by="eve").get("ok", True)
    drive.stands(moving)
    before = time.monotonic()
    drive.resume()
    drive.command(0.0)
    for _ in range(5):
        drive.command(0.3, at=before)
    drive.never_goes(0.3)
    drive.start()


@case("resume", "SPEC 2.5-52")
def test_stall_is_no_silence(drive: Wheels) -> None:
    """A link without messages for a while, followed by delayed ones, is no release."""
    moving = drive.start()
    assert drive.control.order("stop", by="eve").get("ok", True)
    drive.stands(moving)
    drive.streams(0.2, 0.3)
    drive.resume()
    drive.streams(0.2, 0.2)
    last = time.monotonic()
    drive.command(0.2)
    time.sleep(0.55)  # the link stalls
    for _ in range(5):
        drive.command(0.3, at=last + 0.2)
    drive.never_goes(0.3)
    drive.start()


@case("control", "SPEC 2.5-52")
def test_sent_before_control_was_lost(drive: Wheels) -> None:
    """A source with control again is not obeyed in commands that it may have sent before it lost control."""
    drive.start()
    before = time.monotonic()
    drive.give(OTHER)
    drive.give(DRIVER)
    drive.command(0.0)
    for _ in range(5):
        drive.command(0.3, at=before)
    drive.never_goes(0.3)
    drive.start()


@case("suppress", "SPEC 2.5-48")
def test_suppress(drive: Wheels) -> None:
    """For its time only the named sources are obeyed; at its begin and end the motion of others is stopped."""
    drive.start()
    drive.command(0.0, source=OTHER)  # releases motion of an earlier link
    done = drive.control.order("suppress", resource=drive.topic, sources=[OTHER], ms=200, by="a case")
    assert done.get("ok", True), done
    begun = time.monotonic()
    drive.command(0.3)
    drive.command(0.1, source=OTHER)
    speeds = []
    while time.monotonic() < begun + 1:
        speeds.append(drive.next_speed(0.05))
    heard = [each for each in speeds if each is not None]
    assert 0.3 not in heard, heard
    assert 0.1 in heard, heard
    assert heard[-1] == 0, heard
    drive.command(0.1, source=OTHER)
    drive.never_moves()
    drive.start()


@case("suppress", "SPEC 2.5-48")
def test_suppression_ends_in_time(drive: Wheels) -> None:
    """A renewed suppression continues; otherwise the robot is stopped when its time is over."""
    drive.start()
    drive.command(0.0, source=OTHER)  # releases motion of an earlier link
    moving = None
    for _ in range(5):
        drive.control.order("suppress", resource=drive.topic, sources=[OTHER], ms=150)
        drive.command(0.1, source=OTHER)
        time.sleep(0.05)  # renewed before it ends
    last = time.time()
    while drive.next_speed(0.5) not in (0, None):
        moving = time.time()
    assert (moving or last) - last < 0.4
