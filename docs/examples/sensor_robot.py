"""A robot that measures and moves nothing, in as few lines as is honest. docs/guides/robots.md begins with it.

python sensor_robot.py HOST PORT ROBOT CODE FILE    (the enrolment code is needed once; the file keeps the key)
"""

import asyncio
import base64
import hashlib
import json
import math
import os
import random
import struct
import sys
import time
from contextlib import closing
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

TOPIC, TYPE = "/temperature", "std_msgs/msg/Float32"
ORDERS = ("control_grant", "stop", "resume", "suppress", "inhibit")
HOST, PORT, NAME, CODE, FILE = sys.argv[1:]
quiet = {"until": 0.0, "hold": False}


def measure():
    """A real robot reads its sensor here."""
    return {"data": 20 + math.sin(time.time())}


# 1. Links: frames of four bytes of length, one of kind, and the body


class Refused(Exception):
    """The relay does not want us: why, and after how many seconds to ask again."""


async def dial(limit):
    # With TLS: open_connection(HOST, PORT, ssl=True)
    return Link(limit, *await asyncio.wait_for(asyncio.open_connection(HOST, PORT), 6))


class Link:
    def __init__(self, limit, reader, writer):
        self.limit, self.reader, self.writer = limit, reader, writer
        self.heartbeat, self.ping_due, self.subscriptions = 2.0, math.inf, {}
        self.last = None
        self.beating = asyncio.create_task(self.beat())
        self.beating.add_done_callback(lambda _: writer.transport.abort())  # also when a measurement fails

    def close(self):
        self.beating.cancel()

    def send(self, kind, body):
        self.writer.write(struct.pack("!IB", len(body) + 1, kind) + body)
        if self.writer.transport.get_write_buffer_size() > 64 * 1024:
            self.close()  # the relay takes nothing

    def say(self, op, **fields):
        self.send(0, json.dumps({"op": op, **fields}).encode())

    async def frame(self):
        """The next frame. Its length is judged before the rest of it is awaited."""
        length = int.from_bytes(await self.reader.readexactly(4), "big")
        if not 1 <= length <= self.limit:
            raise ValueError(f"a frame of {length} bytes breaks the contract")
        frame = await self.reader.readexactly(length)
        if (frame[0] == 1 and length >= 13) or (frame[0] == 5 and length >= 17):
            return {"op": "sample"}
        if frame[0] != 0:
            raise ValueError(f"a frame of kind {frame[0]} with {length} bytes breaks the contract")
        return json.loads(frame[1:])

    async def take(self, *wanted):
        """The next message that is not about the link itself; if one is wanted, it must be that."""
        while True:
            try:
                said = await asyncio.wait_for(self.frame(), 3 * self.heartbeat)
            except (EOFError, asyncio.TimeoutError):
                raise EOFError("the relay hung up, or is silent") from None
            if said["op"] == "ping":
                self.say("pong", t=said["t"], at=time.monotonic_ns())
            elif said["op"] == "refused":  # without a time only a person can help
                raise Refused(said["reason"], min(max(0.25, float(said.get("retry_after") or 30)), 3600))
            elif said["op"] == "bye" or (wanted and said["op"] not in (*wanted, "pong")):
                raise ValueError(f"the relay says {said}")
            elif said["op"] != "pong":
                return said

    async def beat(self):
        while True:
            if time.monotonic() >= self.ping_due:
                self.ping_due = time.monotonic() + min(1, self.heartbeat)
                self.say("ping", t=time.monotonic_ns())
            for number, each in self.subscriptions.items():
                # Nothing waits behind a slow link: the next sample is newer.
                if time.monotonic() >= each["due"] and not self.writer.transport.get_write_buffer_size():
                    each["due"] = time.monotonic() + each["every"]
                    if time.monotonic() >= quiet["until"]:
                        self.last = json.dumps(measure()).encode()
                    elif not quiet["hold"] or self.last is None:
                        continue
                    self.send(1, struct.pack("!IQ", number, time.time_ns()) + self.last)
            await asyncio.sleep(0.02)


# 2. The control link: enrol once, prove who we are, tell what we are, join channels


async def enrol():
    key = Ed25519PrivateKey.generate()
    public_key = base64.b64encode(key.public_key().public_bytes_raw()).decode()
    with closing(await dial(16 * 1024)) as link:
        link.say("enroll", version=1, robot=NAME, code=CODE, public_key=public_key)
        relay = (await link.take("enrolled"))["relay"]
    return {"relay": relay, "robot": NAME, "key": key.private_bytes_raw().hex()}


async def register(control):
    key = Ed25519PrivateKey.from_private_bytes(bytes.fromhex(me["key"]))
    fingerprint = hashlib.sha256(key.public_key().public_bytes_raw()).hexdigest()[:16]
    control.say("hello", version=1, robot=me["robot"], key=fingerprint, encodings=["json"])
    challenge = await control.take("challenge")
    if challenge["relay"] != me["relay"]:
        raise Refused(f"this is not {me['relay']} but {challenge['relay']}: it gets no signature", 30)
    text = b"switchboard robot link 1\0"
    for part in (me["relay"].encode(), me["robot"].encode(), base64.b64decode(challenge["nonce"])):
        text += struct.pack("!H", len(part)) + part
    control.say("prove", signature=base64.b64encode(key.sign(text)).decode())
    control.heartbeat = min(max(0.1, float((await control.take("welcome"))["heartbeat"])), 60)
    control.say("describe", platform="json")
    topics = {TOPIC: {"types": [TYPE], "publishers": ["/robot"]}}
    control.say("graph", full=True, topics=topics, nodes={"/robot": {}})
    control.say("motion_state", **safety(0))
    control.ping_due = 0


def keep(state):
    """Write key, relay and stop where a crash does not reach them."""
    new = Path(FILE + ".new")
    new.touch(0o600)
    with new.open("w") as file:
        file.write(json.dumps(state))
        file.flush()
        os.fsync(file.fileno())
    new.replace(FILE)


def obey(said):
    """Do what the relay orders; what speaks against it. Nothing moves, so there is little to do."""
    op, topic = said["op"], said.get("resource")
    if op == "stop":
        me.setdefault("stopped", {"by": said["by"], "why": said.get("why", ""), "since": time.time()})
        keep(me)
    elif op == "resume":
        me.pop("stopped", None)
        keep(me)
    elif op == "suppress":
        return "nothing here moves"
    elif op == "inhibit" and topic != TOPIC:
        return f"there is no {topic}"
    elif op == "inhibit":
        quiet.update(until=time.monotonic() + said.get("ms", 0) / 1000, hold=said.get("hold", False))
    return ""


def safety(holder):
    left = int(1000 * (quiet["until"] - time.monotonic()))
    inhibited = [{"resource": TOPIC, "hold": quiet["hold"], "ms": left}] if left > 0 else []
    return {"holder": holder, "stopped": me.get("stopped"), "inhibited": inhibited}


async def serve(control):
    channel = asyncio.create_task(asyncio.sleep(0))  # none yet
    holder = 0
    try:
        while True:
            said = await control.take("open_channel", "close_channel", *ORDERS)
            if said["op"] in ORDERS:
                reason = obey(said)
                holder = said.get("holder", 0) if said["op"] == "control_grant" else holder
                control.say("order_result", id=said["id"], ok=not reason, reason=reason)
                control.say("motion_state", **safety(holder))
            if said["op"] == "open_channel":  # one at a time: the new one replaces the old one
                channel.cancel()
                channel = asyncio.create_task(join(control, said["ticket"]))
    finally:  # a channel that is closed ends by itself: the relay hangs up on its link, too
        channel.cancel()


# 3. The channel link: what clients want


async def join(control, ticket):
    try:
        with closing(await dial(4 * 1024 * 1024)) as link:
            link.heartbeat = control.heartbeat
            link.say("join", version=1, ticket=ticket)
            await link.take("joined")
            link.ping_due = 0
            while True:
                request(link, await link.take())
    except Exception as error:
        print(f"the channel ended: {error}", flush=True)


def request(link, said):
    op, number = said["op"], said.get("number")
    if op == "subscribe" and said["topic"] == TOPIC and len(link.subscriptions) < 100:
        link.say("subscribed", number=number, topic=TOPIC, type=TYPE, encoding="json")
        link.subscriptions[number] = {"every": max(50, said.get("throttle_ms", 0)) / 1000, "due": 0}
    elif op == "unsubscribe":
        link.subscriptions.pop(number, None)
    elif op == "call_service":
        link.say("service_response", id=said["id"], result=False, reason="this robot has no services")
    elif op == "send_action_goal":
        link.say("action_result", id=said["id"], status=0, result=False, reason="this robot has no actions")
    elif not op.startswith(("sample", "unadvertise", "cancel_")):  # these want no answer
        ref = next((str(said[each]) for each in ("number", "service", "action", "type") if each in said), "")
        link.say("failed", request=op, reference=ref, reason=f"this robot only publishes {TOPIC}")


# 4. For ever


async def main():
    wait = 0.125
    while True:
        try:
            with closing(await dial(16 * 1024)) as control:
                await register(control)
                wait = 0.125
                await serve(control)
        except Refused as error:
            reason, wait = error.args
        except Exception as error:
            reason, wait = str(error) or "the relay does not answer", min(2 * wait, 15)
        print(f"no link: {reason}", flush=True)
        await asyncio.sleep(random.uniform(wait, 2 * wait))


if not Path(FILE).exists():
    try:
        state = asyncio.run(enrol())
    except Exception as error:
        sys.exit(f"not enrolled: {error.args[0] if error.args else 'the relay does not answer'}")
    keep(state)
me = json.loads(Path(FILE).read_text())
asyncio.run(main())
