"""A robot without ROS: a sensor, wheels with a watchdog, a service. docs/robots.md explains it from top to bottom.

python json_robot.py HOST PORT ROBOT CODE FILE    (the enrolment code is needed once; the file keeps the key)
"""

import base64
import hashlib
import json
import math
import random
import secrets
import select
import signal
import socket
import struct
import sys
import time
from collections import deque
from pathlib import Path
from types import SimpleNamespace

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

MS, SECOND = 1_000_000, 1_000_000_000  # nanoseconds
CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # nobody sets it, and it goes on in a suspend
TWIST, FLOAT, TRIGGER = "geometry_msgs/msg/Twist", "std_msgs/msg/Float64", "std_srvs/srv/Trigger"
SENSORS = {
    "/temperature": (FLOAT, lambda: {"data": 20 + math.sin(time.time())}),
    "/cmd_vel/heard": (TWIST, lambda: robot.told),
}
MOTION = {"types": [TWIST], "deadline_ms": 500, "stop_within_ms": 500}
HOST, PORT, NAME, CODE, FILE = sys.argv[1:]
robot = SimpleNamespace(v=0.0, w=0.0, until=0, told={}, heartbeat=2.0, wait=0.5)


def now():
    return time.clock_gettime_ns(CLOCK)


# 1. The wheels, driven by a timer that interrupts whatever the rest of the program is doing


def motors(v, w):
    """A real robot talks to its motors here. This one says on a topic what they were told."""
    robot.told = {"linear": {"x": v, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": w}}


def every_20_ms(*_):
    if now() > robot.until:  # the watchdog
        robot.v = robot.w = 0.0
    motors(robot.v, robot.w)


# 2. Frames: four bytes of length, one of kind, the body


def dial(address, limit):
    connection = socket.create_connection(address, timeout=6)
    # With TLS: connection = ssl.create_default_context().wrap_socket(connection, server_hostname=HOST)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    link = SimpleNamespace(socket=connection, limit=limit, buffer=bytearray(), heard=now(), ping_due=math.inf)
    link.subscriptions, link.commands, link.exchanges = {}, set(), deque(maxlen=16)
    return link


def send(link, kind, body):
    link.socket.sendall(struct.pack("!IB", len(body) + 1, kind) + body)


def say(link, op, **fields):
    send(link, 0, json.dumps({"op": op, **fields}).encode())


def receive(link):
    """The messages that have come. The length of a frame is judged before the rest of it is awaited."""
    data = link.socket.recv(65536)
    if not data:
        raise EOFError("the relay hung up")
    link.heard = now()
    link.buffer += data
    while len(link.buffer) >= 5:
        length, kind = struct.unpack_from("!IB", link.buffer)
        if not 1 <= length <= link.limit or kind > 1:
            raise ValueError(f"a frame of kind {kind} with {length} bytes breaks the contract")
        if len(link.buffer) < 4 + length:
            return
        body = bytes(link.buffer[5 : 4 + length])
        del link.buffer[: 4 + length]
        if kind == 0:
            yield json.loads(body)
        else:
            number, stamp = struct.unpack_from("!IQ", body)
            yield {"op": "sample", "number": number, "stamp": stamp, "message": body[12:]}


# 3. The control link: enrol once, prove who we are, say what we are, open channels


def greet(control):
    public = key.public_key().public_bytes_raw()
    if "relay" in me:
        short = hashlib.sha256(public).hexdigest()[:16]
        say(control, "hello", version=1, robot=me["robot"], key=short, encodings=["json"])
    else:
        public_key = base64.b64encode(public).decode()
        say(control, "enroll", version=1, robot=me["robot"], code=CODE, public_key=public_key)


def prove(control, nonce):
    parts = me["relay"].encode(), me["robot"].encode(), base64.b64decode(nonce)
    text = b"switchboard robot link 1\0" + b"".join(struct.pack("!H", len(part)) + part for part in parts)
    say(control, "prove", signature=base64.b64encode(key.sign(text)).decode())


def describe(control):
    topics = {name: {"types": [kind], "publishers": ["/robot"]} for name, (kind, _) in SENSORS.items()}
    topics["/cmd_vel"] = {"types": [TWIST], "subscribers": ["/robot"]}
    services = {"/beep": {"types": [TRIGGER], "providers": ["/robot"]}}
    say(control, "describe", platform="json", motion=MOTION)
    say(control, "graph", full=True, topics=topics, services=services, nodes={"/robot": {}})


def order(links, control, op, said):
    if op == "enrolled":
        me["relay"] = said["relay"]
        Path(FILE).touch(0o600)
        Path(FILE).write_text(json.dumps(me))
        raise EOFError("enrolled, now to dial again")
    if op == "challenge" and said["relay"] == me["relay"]:
        prove(control, said["nonce"])
    elif op == "welcome":
        robot.heartbeat = min(max(0.1, float(said["heartbeat"])), 60)
        robot.wait, control.ping_due = 0.5, 0
        describe(control)
    elif op == "open_channel" and len(links) < 10:
        links.append(dial(control.socket.getpeername()[:2], 4 * 1024 * 1024))
        say(links[-1], "join", version=1, ticket=said["ticket"])
    elif op != "close_channel":  # the relay then hangs up on the channel's own link, too
        if op in ("refused", "challenge"):  # a challenge of another relay: nothing was signed
            seconds = float(said.get("retry_after") or 30)  # without a time only a person can help
            robot.wait = min(max(0.5, 2 * seconds), 3600)
        raise ValueError(f"the relay says {said}")


# 4. Channel links: what clients want


def request(link, op, said):
    number, topic = said.get("number"), said.get("topic")
    room = len(link.subscriptions) + len(link.commands) < 100
    if op == "joined":
        link.ping_due = 0
    elif op == "subscribe" and topic in SENSORS and room:
        every = max(50, said.get("throttle_ms", 0)) * MS
        link.subscriptions[number] = {"topic": topic, "every": every, "due": 0}
        say(link, "subscribed", number=number, topic=topic, type=SENSORS[topic][0], encoding="json")
    elif op == "unsubscribe":
        link.subscriptions.pop(number, None)
    elif op == "advertise" and topic == "/cmd_vel" and said["type"] == TWIST and room:
        link.commands.add(number)
        say(link, "advertised", number=number, topic=topic, type=TWIST, encoding="json", motion=True)
    elif op == "unadvertise":
        link.commands.discard(number)
        robot.until = 0
    elif op == "sample":
        if number in link.commands:
            command(link, said["stamp"], said["message"])
    elif op == "call_service" and said["service"] == "/beep":
        say(link, "service_response", id=said["id"], result=True, values={"success": True, "message": "beep"})
    elif op == "call_service":
        say(link, "service_response", id=said["id"], result=False, reason="there is only /beep")
    elif op == "send_action_goal":
        say(link, "action_result", id=said["id"], status=0, result=False, reason="there are no actions")
    elif not op.startswith(("unadvertise_", "cancel_")):  # these want no answer
        ref = next((str(said[each]) for each in ("number", "service", "action", "type") if each in said), "")
        say(link, "failed", what=op, ref=ref, reason="this small robot does not have that")


def publish(link):
    for number, each in link.subscriptions.items():
        if now() >= each["due"] and select.select([], [link.socket], [], 0)[1]:  # never wait to send a sample
            each["due"] = now() + each["every"]
            sample = json.dumps(SENSORS[each["topic"]][1]()).encode()
            send(link, 1, struct.pack("!IQ", number, time.time_ns()) + sample)


# 5. Commands: how old can one be, by what the pings say of the relay's clock?


def ahead(link):
    """The relay's clock showed `at` after ours had shown `t`, so it is ahead by no more than `at - t`."""
    return min(at - t + (now() - t) // 1000 for t, at in link.exchanges)


def compare(link, t, at):
    if link.exchanges and ahead(link) < at - now():
        link.exchanges.clear()  # both can't be true: a clock stood still
    link.exchanges.append((t, at))


def command(link, stamp, body):
    try:
        twist = json.loads(body)
        speeds = [float(twist.get(part, {}).get(axis, 0)) for part in ("linear", "angular") for axis in "xyz"]
        age = now() + ahead(link) - stamp
        if not 0 <= age <= MOTION["deadline_ms"] * MS or not all(map(math.isfinite, speeds)):
            raise ValueError(f"speeds {speeds}, up to {age / SECOND:.3f} s old")
    except Exception as error:
        print(f"a command was dropped: {error}", flush=True)
    else:
        robot.until = now() + (MOTION["stop_within_ms"] - 100) * MS
        robot.v, robot.w = speeds[0], speeds[5]


# 6. All links in turn, for ever


def serve(links, link, ready):
    for said in receive(link) if ready else ():
        if said["op"] == "ping":
            say(link, "pong", t=said["t"], at=now())
        elif said["op"] == "pong":
            compare(link, said["t"], said["at"])
        elif link is links[0]:
            order(links, link, said["op"], said)
        else:
            request(link, said["op"], said)
    if now() - link.heard > 3 * robot.heartbeat * SECOND:
        raise TimeoutError("the relay is silent")
    if now() >= link.ping_due:
        link.ping_due = now() + min(1, robot.heartbeat) * SECOND
        say(link, "ping", t=now())
    publish(link)


def leave(links, link):
    links.remove(link)
    link.socket.close()
    robot.until = 0


def live(links):
    links.append(dial((HOST, int(PORT)), 16 * 1024))  # the first is the control link
    greet(links[0])
    while True:
        ready = select.select([link.socket for link in links], [], [], 0.02)[0]
        for link in list(links):
            try:
                serve(links, link, link.socket in ready)
            except Exception as error:
                if link is links[0]:
                    raise
                print(f"a channel ended: {error}", flush=True)
                leave(links, link)


me = {"robot": NAME, "key": secrets.token_hex(32)}
if Path(FILE).exists():
    me = json.loads(Path(FILE).read_text())
key = Ed25519PrivateKey.from_private_bytes(bytes.fromhex(me["key"]))
signal.signal(signal.SIGTERM, lambda *_: sys.exit())
signal.signal(signal.SIGALRM, every_20_ms)
signal.setitimer(signal.ITIMER_REAL, 0.02, 0.02)
try:
    while True:
        links, robot.heartbeat, robot.wait = [], 2.0, min(2 * robot.wait, 30)
        try:
            live(links)
        except Exception as error:
            print(f"no link: {error}", flush=True)
        for link in list(links):
            leave(links, link)
        if "relay" not in me:
            sys.exit("not enrolled")
        time.sleep(robot.wait * random.uniform(0.5, 1))
finally:
    robot.until = 0
    signal.setitimer(signal.ITIMER_REAL, 0)
    motors(0.0, 0.0)
