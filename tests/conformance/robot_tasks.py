"""Actions of robot link cases on a robot: find its resources, subscribe, call, drive."""

from __future__ import annotations

import base64
import contextlib
import json
import struct
import time
from collections.abc import Callable
from typing import Any

from conformance_suite import not_offered
from link_relay import ABSENCE, PATIENCE, Link, LinkRelay, Sample

TWIST = "geometry_msgs/msg/Twist"
TRIGGER = "std_srvs/srv/Trigger"
FIBONACCI = "example_interfaces/action/Fibonacci"
CDR = b"\0\1\0\0"
OVERTAKEN = 0.1
"""Seconds by which zero may come before a command that was sent earlier."""
LATE = 0.75
"""Seconds over its promise that a robot is forgiven on a computer that runs other things beside it."""
DRIVER = 11
"""The source that drives, unless a case says another."""


def sensor(relay: LinkRelay) -> tuple[str, str]:
    """A topic that it publishes often, and its type."""
    topics = relay.graph["topics"]
    published = [
        name for name, each in topics.items() if each.get("publishers") and not name.endswith("/heard")
    ]
    likely = sorted(
        published, key=lambda name: ("counter" not in name, "rosout" in name, "parameter" in name, name)
    )
    if not likely:
        not_offered("the robot publishes no topic")
    return likely[0], topics[likely[0]]["types"][0]


def service(relay: LinkRelay) -> str:
    """A service of type Trigger."""
    found = sorted(name for name, each in relay.graph["services"].items() if TRIGGER in each["types"])
    if not found:
        not_offered(f"no service of type {TRIGGER}")
    return str(found[0])


def subscribe(link: Link, relay: LinkRelay, number: int = 7, **fields: Any) -> dict[str, Any]:
    """Subscribes to the sensor; returns the robot's answer."""
    topic, type_name = sensor(relay)
    link.say("subscribe", number=number, topic=topic, type=type_name, **fields)
    return link.expect("subscribed", number=number)


def stands(link: Link, asked: str, answer: str) -> bool:
    """Whether the request is in effect; ``failed`` otherwise."""
    reported = link.take(
        f"'{answer}' or 'failed'", lambda each: isinstance(each, dict) and each["op"] in (answer, "failed")
    )
    assert reported["op"] == answer or reported["request"] == asked
    return bool(reported["op"] == answer)


def fibonacci(relay: LinkRelay, link: Link, order: int, **fields: Any) -> None:
    """Sends a goal, id ``g``, to an action of type Fibonacci."""
    actions = relay.graph["actions"]
    found = sorted(name for name, each in actions.items() if FIBONACCI in each["types"])
    if not found:
        not_offered(f"no action of type {FIBONACCI}")
    goal = base64.b64encode(CDR + struct.pack("<i", order)).decode()
    link.say("send_action_goal", id="g", action=found[0], type=FIBONACCI, cdr=goal, **fields)


def wheels(relay: LinkRelay) -> str:
    """The topic of type Twist that moves the robot, with a report of it on ``…/heard``."""
    topics = relay.graph["topics"]
    for name, each in topics.items():
        if f"{name}/heard" in topics and TWIST in each["types"]:
            return str(name)
    not_offered("no topic of type Twist with a topic …/heard beside it")
    raise AssertionError


class Wheels:
    """Drives the robot by one channel link, and reads reports of its motion by another.

    :param resume: whether a stopped robot is resumed first
    :param held_up: seconds so far for which the computer may have held up the robot
    """

    def __init__(
        self,
        relay: LinkRelay,
        driving: Link,
        watching: Link,
        resume: bool = True,
        held_up: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self._held_up = held_up
        topic = wheels(relay)
        policy = relay.facts().get("motion", {})
        self.deadline = policy.get("deadline_ms", 500) / 1000
        self.stop_within = policy.get("stop_within_ms", 500) / 1000
        self.driving, self.watching = driving, watching
        self.control = relay.control
        self._sent = time.monotonic()
        """When the latest command of a stream was sent, or the resume before it."""
        if resume:
            self.resume()
        self.give(DRIVER)
        watching.say("subscribe", number=1, topic=f"{topic}/heard", type=TWIST)
        self._heard_encoding = watching.expect("subscribed", number=1)["encoding"]
        self.topic = topic
        self.advertise()
        # Motion of the case before stops by itself.
        while self.next_speed(self.stop_within + 0.1):
            pass

    def advertise(self) -> None:
        """Advertises commands."""
        self.driving.say("advertise", number=2, topic=self.topic, type=TWIST)
        self.reported = self.driving.expect("advertised", number=2)

    def give(self, source: int) -> None:
        """Gives control to a source."""
        done = self.control.order("control_grant", holder=source, user="the suite", level="operator")
        assert done.get("ok", True), done

    def resume(self) -> None:
        """Resumes it after a stop."""
        self._sent = time.monotonic()
        done = self.control.order("resume", by="the suite")
        assert done.get("ok", True), done

    def streams(self, speed: float, seconds: float) -> None:
        """Commands without a pause; the robot does not move."""
        until = time.monotonic() + seconds
        while (now := time.monotonic()) < until:
            # If this process stalls, it counts as a link that does, not as a pause.
            self.command(speed, at=self._sent)
            self._sent = now
            assert self.next_speed(0.05) != speed, "it moves"

    def command(
        self, speed: float, age: float = 0.0, source: int = DRIVER, *, at: float | None = None
    ) -> None:
        """Sends a command; ``at`` as of :meth:`link_relay.Link.command`."""
        self.driving.command(2, self.twist(speed), source, age, at)

    def twist(self, speed: float) -> bytes:
        """A command's body."""
        if self.reported["encoding"] != "json":
            return CDR + struct.pack("<6d", speed, 0, 0, 0, 0, 0)
        twist = {"linear": {"x": speed, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0}}
        return json.dumps(twist).encode()

    def not_finite(self) -> None:
        """Commands whose speed is not finite."""
        for speed in (float("nan"), float("inf"), float("-inf")):
            self.command(speed)
        if self.reported["encoding"] == "json":
            for text in (b"null", b"1e999", b"-1e999"):
                self.driving.command(2, b'{"linear": {"x": ' + text + b'}, "angular": {}}', DRIVER)

    def speed(self, sample: Sample) -> float:
        """The forward speed of a report."""
        if self._heard_encoding == "json":
            return float(json.loads(sample.body)["linear"]["x"])
        return float(struct.unpack_from("<d" if sample.body[1] & 1 else ">d", sample.body, 4)[0])

    def next_speed(self, seconds: float) -> float | None:
        """The next report, if one comes."""
        with contextlib.suppress(AssertionError):
            return self.speed(self.watching.expect_sample(1, seconds))
        return None

    def start(self, source: int = DRIVER) -> Sample:
        """Commands until it moves; returns the first report. A zero before releases the controls."""
        until = time.monotonic() + PATIENCE
        self.command(0.0, source=source)
        while True:
            assert time.monotonic() < until, "commands, sent again and again, did not move the robot"
            self.command(0.2, source=source)
            with contextlib.suppress(AssertionError):
                report = self.watching.expect_sample(1, 0.05)
                if self.speed(report) == 0.2:
                    return report

    def stands(self, moving: Sample) -> float:
        """Waits until it stands; returns seconds from the last report of motion, no earlier than ``moving``.

        Zero may overtake the latest command, if another part of the robot sends it: the next report decides.
        """
        stood: Sample | None = None
        while True:
            try:
                report = self.watching.expect_sample(1, PATIENCE if stood is None else OVERTAKEN)
            except AssertionError:
                if stood is None:
                    raise
                return (stood.stamp - moving.stamp) / 1e9
            if self.speed(report) != 0:
                moving, stood = report, None
            elif stood is None:
                stood = report
            elif report.stamp - stood.stamp > OVERTAKEN * 1e9:
                return (stood.stamp - moving.stamp) / 1e9

    def stands_in_time(self, moving: Sample) -> None:
        """Waits until it stands, which it promises to do within ``stop_within_ms``."""
        before = self._held_up()
        took = self.stands(moving)
        assert took <= self.stop_within + LATE + self._held_up() - before, f"it took {took * 1000:.0f} ms"

    def never_moves(self, seconds: float = ABSENCE) -> None:
        """Only standstill is reported within this time."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            assert not self.next_speed(left), "it moves"

    def never_goes(self, speed: float, seconds: float = ABSENCE) -> None:
        """No command of this speed is obeyed within this time; the last one of another speed may still be
        reported.
        """
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            assert self.next_speed(left) != speed, f"it obeys the command of {speed} m/s"
