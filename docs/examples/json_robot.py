"""A robot without ROS: the robot link (protocol/SPEC.md, section 2) spoken in JSON. docs/robots.md goes through it.

One sensor (/temperature), wheels with a watchdog of their own (/cmd_vel), one service (/beep). It needs Python and
``cryptography``:  python json_robot.py --relay HOST:9091 --robot tin-man --code CODE --state robot.json [--tls]
"""

import argparse
import asyncio
import base64
import contextlib
import hashlib
import json
import math
import random
import ssl
import struct
import time
from collections import deque
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

TWIST, FLOAT, TRIGGER = "geometry_msgs/msg/Twist", "std_msgs/msg/Float64", "std_srvs/srv/Trigger"
OFFERED = {"/temperature": FLOAT, "/cmd_vel/heard": TWIST}
MS, DEADLINE, STOP_WITHIN = 1_000_000, 500, 500
SMALL, LARGE = 16 * 1024, 4 * 1024 * 1024  # frames before the proof, and after (SPEC 2.1)
TROUBLE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    asyncio.TimeoutError,
    struct.error,
)


def clock():
    """Nanoseconds of a clock that nobody sets and that goes on in a suspend, where there is one."""
    return time.clock_gettime_ns(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class Link:
    """Frames on one connection (SPEC 2.1); pings answered, silence noticed, clocks compared (2.3, 2.5)."""

    def __init__(self, reader, writer):
        self.reader, self.writer, self.limit, self.heartbeat = reader, writer, SMALL, 2.0
        self.exchanges = deque(maxlen=16)

    def frame(self, kind, body):
        self.writer.write(struct.pack("!IB", len(body) + 1, kind) + body)

    def say(self, op, **fields):
        if self.writer.transport.get_write_buffer_size() > LARGE:
            raise ValueError("the relay takes nothing")
        self.frame(0, json.dumps({"op": op, **fields}).encode())

    async def read(self):
        length, kind = struct.unpack("!IB", await self.reader.readexactly(5))
        if not 1 <= length <= self.limit or kind > 1:  # judged before a byte of it is awaited
            raise ValueError(f"a frame of kind {kind} with {length} bytes breaks the contract")
        return kind, await self.reader.readexactly(length - 1)

    async def message(self):
        """The next message (a dict), or sample (number, stamp, body)."""
        while True:
            kind, body = await asyncio.wait_for(self.read(), 3 * self.heartbeat)
            if kind == 1:
                return (*struct.unpack("!IQ", body[:12]), body[12:])
            said = json.loads(body)
            if said["op"] == "ping":
                self.say("pong", t=said["t"], at=clock())
            elif said["op"] == "pong":
                self.compare(said["t"], said["at"], clock())
            elif said["op"] in ("bye", "refused"):
                raise EOFError(f"the relay says {said['op']}: {said['reason']}")
            else:
                return said

    def compare(self, t, at, now):
        """The relay read its clock as ``at``, after we sent at ``t`` and before we heard at ``now``."""
        if self.exchanges and self.ahead(now) < at - now:
            self.exchanges.clear()  # both can't be true: a clock stood still
        self.exchanges.append((t, at))

    def ahead(self, now):
        """How far the relay's clock can be ahead of ours, at most."""
        return min(at - t + (now - t) // 1000 for t, at in self.exchanges)

    async def ping(self, seconds):
        while True:
            self.say("ping", t=clock())
            await asyncio.sleep(seconds)


class Wheels:
    """What moves. It comes to a standstill by itself, whatever became of everybody else."""

    def __init__(self, drive):
        self.drive, self.moving, self.zeros, self.last, self.driver = drive, False, 0, 0, None

    def command(self, driver, stamp, body, link):
        """Obey a command that is fresh by the worst we know of the clocks, and made of numbers."""
        now, twist = clock(), json.loads(body)
        age = now + link.ahead(now) - stamp
        v, w = (float(twist.get(part, {}).get(axis, 0)) for part, axis in (("linear", "x"), ("angular", "z")))
        if not 0 <= age <= DEADLINE * MS or not math.isfinite(v) or not math.isfinite(w):
            print("a command was too old or no number; dropped", flush=True)
        elif v or w:
            self.moving, self.zeros, self.last, self.driver = True, 0, now, driver
            self.drive(v, w)
        else:
            self.stop()

    def stop(self, driver=None):
        """Stand still; with ``driver`` only what this one has left moving. It is said five times (SPEC 2.5, 6)."""
        if self.moving and driver in (None, self.driver):
            self.moving, self.zeros = False, 5

    async def watch(self):
        while True:
            if self.moving and clock() - self.last > (STOP_WITHIN - 50) * MS:
                self.stop()
            if self.zeros:
                self.zeros -= 1
                self.drive(0.0, 0.0)
            await asyncio.sleep(0.02)


class Robot:
    def __init__(self, options):
        self.options, self.subscriptions, self.latest = options, {}, {}
        self.wheels = Wheels(self.drive)
        self.drive(0.0, 0.0)

    def drive(self, v, w):
        """A real robot talks to its motors here. This one says on a topic what they were told."""
        self.publish(
            "/cmd_vel/heard", {"linear": {"x": v, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": w}}
        )

    async def sense(self):
        while True:
            self.publish("/temperature", {"data": 20 + math.sin(time.time())})
            await asyncio.sleep(0.05)

    def publish(self, topic, message):
        self.latest[topic] = message
        for (link, number), each in self.subscriptions.items():
            free = link.writer.transport.get_write_buffer_size() < LARGE  # who takes nothing gets nothing
            if each["topic"] == topic and clock() >= each["due"] and free:
                each["due"] = clock() + each["every"] * MS
                self.send(link, number, message)

    def send(self, link, number, message):
        link.frame(1, struct.pack("!IQ", number, time.time_ns()) + json.dumps(message).encode())

    async def dial(self):
        host, _, port = self.options.relay.rpartition(":")
        tls = ssl.create_default_context(cafile=self.options.ca) if self.options.tls else None
        return Link(*await asyncio.wait_for(asyncio.open_connection(host, int(port), ssl=tls), 10))

    async def enroll(self):
        """Make a key pair; only its public half leaves the robot."""
        key, link = Ed25519PrivateKey.generate(), await self.dial()
        public = base64.b64encode(key.public_key().public_bytes_raw()).decode()
        link.say("enroll", version=1, robot=self.options.robot, code=self.options.code, public_key=public)
        enrolled = await link.message()
        self.options.state.touch(0o600)
        kept = {"robot": enrolled["robot"], "relay": enrolled["relay"], "key": key.private_bytes_raw().hex()}
        self.options.state.write_text(json.dumps(kept))
        link.writer.close()

    async def run(self):
        if not self.options.state.exists():
            await self.enroll()
        self.me, failures = json.loads(self.options.state.read_text()), 0
        own = asyncio.gather(self.wheels.watch(), self.sense())
        try:
            while True:
                life = asyncio.create_task(self.control())
                await asyncio.wait({own, life}, return_when=asyncio.FIRST_COMPLETED)
                if own.done():  # without its watchdog this robot does not go on
                    return own.result()
                failures = 0 if life.result() else min(failures + 1, 5)
                self.wheels.stop()
                await asyncio.sleep(random.random() * 0.5 * 2**failures)
        finally:
            self.drive(0.0, 0.0)

    async def control(self):
        """One life of the control link (SPEC 2.2, 2.4); whether the relay took us in."""
        jobs, link, welcome = set(), None, {}
        try:
            link, key = await self.dial(), Ed25519PrivateKey.from_private_bytes(bytes.fromhex(self.me["key"]))
            short = hashlib.sha256(key.public_key().public_bytes_raw()).hexdigest()[:16]
            link.say(
                "hello", version=1, robot=self.me["robot"], key=short, encodings=["json"], agent="json_robot"
            )
            challenge = await link.message()
            if challenge["relay"] != self.me["relay"]:
                raise ValueError(f"this is {challenge['relay']}, not {self.me['relay']}; nothing was signed")
            parts = self.me["relay"].encode(), self.me["robot"].encode(), base64.b64decode(challenge["nonce"])
            text = b"switchboard robot link 1\0" + b"".join(len(p).to_bytes(2, "big") + p for p in parts)
            link.say("prove", signature=base64.b64encode(key.sign(text)).decode())
            welcome = await link.message()
            link.heartbeat, link.limit = welcome["heartbeat"], LARGE
            motion = {"types": [TWIST], "deadline_ms": DEADLINE, "stop_within_ms": STOP_WITHIN}
            link.say("describe", platform="json", agent="json_robot", motion=motion)
            topics = {name: {"types": [kind], "publishers": ["/robot"]} for name, kind in OFFERED.items()}
            topics["/cmd_vel"] = {"types": [TWIST], "subscribers": ["/robot"]}
            services = {"/beep": {"types": [TRIGGER], "providers": ["/robot"]}}
            link.say("graph", full=True, topics=topics, services=services, nodes={"/robot": {}})
            jobs.add(asyncio.create_task(link.ping(link.heartbeat)))
            while True:
                order = await link.message()
                if order["op"] == "open_channel":
                    jobs.add(asyncio.create_task(self.channel(order["ticket"], link.heartbeat)))
                elif order["op"] != "close_channel":  # that one also closes the channel's own link
                    raise ValueError(f"'{order['op']}' is not known here")
        except TROUBLE as error:
            print(f"the link is lost: {error or type(error).__name__}", flush=True)
        finally:
            for job in jobs:
                job.cancel()
            if link:
                link.writer.close()
        return bool(welcome)

    async def channel(self, ticket, heartbeat):
        """One life of a channel link (SPEC 2.5)."""
        link, commands, pinging = await self.dial(), set(), None
        link.heartbeat, link.limit = heartbeat, LARGE
        try:
            asked = clock()
            link.say("join", version=1, ticket=ticket)
            link.compare(asked, (await link.message())["at"], clock())
            pinging = asyncio.create_task(link.ping(1.0))
            while True:
                said = await link.message()
                if isinstance(said, dict):
                    self.request(link, said, commands)
                elif said[0] in commands:
                    with contextlib.suppress(ValueError, TypeError, AttributeError):  # no command at all
                        self.wheels.command((link, said[0]), said[1], said[2], link)
        except TROUBLE as error:
            print(f"a channel is lost: {error or type(error).__name__}", flush=True)
        finally:
            for number in commands:
                self.wheels.stop((link, number))
            self.subscriptions = {key: each for key, each in self.subscriptions.items() if key[0] is not link}
            if pinging:
                pinging.cancel()
            link.writer.close()

    def request(self, link, said, commands):
        op, number, topic = said["op"], said.get("number"), said.get("topic")
        room = len(commands) + len(self.subscriptions) < 100
        if op == "subscribe" and topic in OFFERED and room:
            again = (link, number) in self.subscriptions
            self.subscriptions[link, number] = {"topic": topic, "every": said.get("throttle_ms", 0), "due": 0}
            link.say(
                "subscribed", number=number, topic=topic, type=OFFERED[topic], encoding="json", publishers=1
            )
            if not again:
                self.send(link, number, self.latest[topic])
        elif op == "unsubscribe":
            self.subscriptions.pop((link, number), None)
        elif op == "advertise" and topic == "/cmd_vel" and said["type"] == TWIST and room:
            commands.add(number)
            link.say("advertised", number=number, topic=topic, type=TWIST, encoding="json", motion=True)
        elif op == "unadvertise":
            commands.discard(number)
            self.wheels.stop((link, number))
        elif op == "call_service":
            known = said["service"] == "/beep"
            answer = (
                {"values": {"success": True, "message": "beep"}}
                if known
                else {"reason": "there is only /beep"}
            )
            link.say("service_response", id=said["id"], result=known, **answer)
        elif op == "send_action_goal":
            link.say(
                "action_result", id=said["id"], status=0, result=False, reason="this robot has no actions"
            )
        elif op in (
            "subscribe",
            "advertise",
            "advertise_service",
            "advertise_action",
            "get_type",
            "get_interfaces",
        ):
            ref = next((str(said[key]) for key in ("number", "service", "action", "type") if key in said), "")
            link.say("failed", what=op, ref=ref, reason="this small robot does not have that")
        elif op not in (
            "unadvertise_service",
            "unadvertise_action",
            "cancel_action_goal",
            "service_response",
        ):
            link.say("bye", reason=f"'{op}' is not known here")
            raise ValueError(f"'{op}' is not known here")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="a robot that speaks JSON only")
    parser.add_argument("--relay", required=True, help="HOST:PORT of the relay's robot port")
    parser.add_argument("--robot", required=True, help="its name there")
    parser.add_argument("--code", default="", help="enrolment code, needed once")
    parser.add_argument("--state", required=True, type=Path, help="file for its key")
    parser.add_argument("--tls", action="store_true", help="the relay speaks TLS")
    parser.add_argument("--ca", help="certificate of your own authority")
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(Robot(parser.parse_args()).run())
