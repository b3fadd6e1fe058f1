"""Motion: only fresh commands, and a standstill after any loss."""

from __future__ import annotations

import time

from conformance_suite import case, not_offered
from link_relay import PATIENCE, LinkRelay
from robot_tasks import CDR, DRIVER, Wheels

TRIES = 20
"""Of which one is not held up by a computer that runs other things beside the robot."""


@case("motion", "SPEC 2.5 advertised, motion")
def test_motion_is_known(drive: Wheels) -> None:
    """The robot reports that the topic moves it."""
    assert drive.reported["motion"] is True


@case("motion", "SPEC 2.5-23")
def test_fresh_commands(drive: Wheels) -> None:
    """Fresh commands are obeyed, and a command of zero stops."""
    moving = drive.start()
    drive.command(0.0)
    drive.stands(moving)


@case("motion", "SPEC 2.5-28")
def test_stops_when_commands_cease(drive: Wheels) -> None:
    """When commands cease the robot stands still within stop_within_ms, while its links live."""
    moving = drive.start()
    for _ in range(3):
        drive.command(0.2)
    drive.stands_in_time(moving)


@case("motion", "SPEC 2.5-27")
def test_zero_is_repeated(drive: Wheels) -> None:
    """Zero is published several times, because a best-effort subscriber may miss the first."""
    drive.stands(drive.start())
    if drive.next_speed(0.5) is None:
        not_offered("zero is said once only (SHOULD)")


@case("motion", "SPEC 2.5-23")
def test_old_commands(drive: Wheels) -> None:
    """Commands older than deadline_ms are dropped."""
    drive.stands(drive.start())
    for _ in range(5):
        drive.command(0.3, age=drive.deadline + 0.05)
    drive.never_goes(0.3)
    drive.start()


@case("motion", "SPEC 2.5-23")
def test_old_commands_do_not_keep_it_moving(drive: Wheels) -> None:
    """Commands that are too old don't keep the robot moving."""
    drive.start()
    until = time.monotonic() + drive.stop_within + 1
    while time.monotonic() < until:
        drive.command(0.3, age=drive.deadline + 0.5)
        assert drive.next_speed(0.05) != 0.3
    drive.command(0.0)
    drive.never_moves()


@case("motion", "SPEC 2.5-23")
def test_commands_of_the_future(drive: Wheels) -> None:
    """Commands that lie in the future are dropped."""
    drive.stands(drive.start())
    for _ in range(5):
        drive.command(0.3, age=-60)
    drive.never_goes(0.3)


@case("motion", "SPEC 2.5-25")
def test_no_number(drive: Wheels) -> None:
    """A command with a number that is not finite is dropped, and the next one is obeyed."""
    drive.stands(drive.start())
    for _ in range(3):
        drive.not_finite()
    drive.never_moves()
    drive.start()


@case("motion", "SPEC 2.5, Clocks and deadline")
def test_nonsense_for_a_command(drive: Wheels) -> None:
    """Bytes that are no command are dropped, and the next command is obeyed."""
    for body in (b"", b"{", b"\0", b"[]", b"null", b'{"linear": 5}', CDR, CDR + b"x" * 47):
        drive.driving.command(2, body, DRIVER)
    drive.never_moves()
    drive.start()


@case("motion", "SPEC 2.5 unadvertise")
def test_unadvertise_stops(drive: Wheels) -> None:
    """unadvertise stops what this publisher left moving, without waiting for the watchdog."""
    took: list[float] = []
    while not took or min(took) >= 0.6 * drive.stop_within:
        assert len(took) < TRIES, f"it took {[f'{each * 1000:.0f}' for each in took]} ms"
        moving = drive.start()
        drive.driving.say("unadvertise", number=2)
        took.append(drive.stands(moving))
        drive.never_moves()
        drive.advertise()


@case("motion", "SPEC 2.5-28")
def test_cut_channel_stops(drive: Wheels) -> None:
    """When the channel link that drives is cut the robot stands still within stop_within_ms."""
    moving = drive.start()
    drive.driving.cut()
    drive.stands_in_time(moving)


@case("motion", "SPEC 2.5-28")
def test_other_samples_are_no_commands(drive: Wheels) -> None:
    """Samples of another number and pings are no commands: they don't keep it moving."""
    drive.start()
    until = time.monotonic() + PATIENCE
    while drive.next_speed(0.05) != 0:
        assert time.monotonic() < until, "it goes on"
        drive.driving.sample(3, b"{}")
        drive.driving.say("ping", t=1)


@case("motion", "SPEC 2.4, losing the control link; 2.5, a new link never resumes motion")
def test_cut_control_stops(relay: LinkRelay, drive: Wheels) -> None:
    """When the control link is cut channels end, and the robot that comes back stands still."""
    drive.start()
    relay.control.cut()
    drive.watching.wait_end()
    drive.driving.wait_end()
    with relay.channel() as watching, relay.channel() as driving:
        again = Wheels(relay, driving, watching)
        # The first report is the latest one, because …/heard is latched.
        assert again.next_speed(2) in (0, None)
        again.never_moves()
        again.start()
