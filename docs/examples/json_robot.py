"""A robot without ROS: a sensor, wheels with a watchdog, a service. docs/guides/robots.md explains it.

python json_robot.py HOST PORT ROBOT CODE FILE    (the enrolment code is needed once; the file keeps the key)
"""

import base64
import hashlib
import json
import math
import os
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
robot = SimpleNamespace(v=0.0, w=0.0, until=0, told={}, heartbeat=2.0, wait=0.5, safety=None)
robot.holder, robot.mover, robot.suppressed, robot.inhibited = 0, 0, {}, {}
robot.commanding, robot.barred = {}, set()  # sources: when they last wanted it to move; who must let go first
robot.turned = 0  # when it was last stopped, resumed or without link
robot.ceded = {}  # sources: when they lost control


def now():
    return time.clock_gettime_ns(CLOCK)


# 1. The wheels, driven by a timer that interrupts whatever the rest of the program is doing


def motors(v, w):
    """A real robot talks to its motors here. This one says on a topic what they were told."""
    robot.told = {"linear": {"x": v, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": w}}


def every_20_ms(*_):
    if now() > robot.until or not moves(robot.mover):  # the watchdog
        robot.v = robot.w = robot.until = 0
    motors(float(robot.v), float(robot.w))


# 2. Who moves them: stop, then whoever suppresses, then whoever holds control


def moves(source):
    if "stopped" in me:
        return False
    if now() < robot.suppressed.get("until", 0):
        return source in robot.suppressed["sources"]
    return source == robot.holder != 0


def obeys(source, moving, sent):
    """Whether this source is obeyed. Who commanded when he might not must let go first: zero, or nothing for 500 ms.

    What can have been sent before a stop or a resume, or before its source lost control, moves nothing any more.
    """
    silent = sent - robot.commanding.pop(source, 0) > 500 * MS
    if silent or not moving:
        robot.barred.discard(source)
    if moving:
        robot.commanding[source] = now()
        if "stopped" in me:
            robot.barred.add(source)
        if len(robot.commanding) > 100:
            robot.commanding.pop(next(iter(robot.commanding)))
    overtaken = moving and sent < max(robot.turned, robot.ceded.get(source, 0))
    return moves(source) and source not in robot.barred and not overtaken


def hold(holder):
    if holder != robot.holder:
        against = now() - robot.commanding.get(holder, 0) <= 500 * MS
        robot.barred = {robot.holder, *({holder} if against and robot.holder else robot.barred & {holder})}
        lately = {each: at for each, at in robot.ceded.items() if now() - at < SECOND}
        robot.ceded = {**lately, robot.holder: now()}  # what was sent before the others is too old
        robot.holder, robot.until = holder, 0


def obey(op, said):
    """Do what the relay orders; what speaks against it."""
    topic, until = said.get("resource"), now() + said.get("ms", 0) * MS
    if op == "control_grant":
        hold(said.get("holder", 0))
    elif op == "stop":
        me.setdefault("stopped", {"by": said["by"], "why": said.get("why", ""), "since": time.time()})
    elif op == "resume":
        me.pop("stopped", None)
        robot.barred.add(robot.holder)
        robot.commanding[robot.holder] = now()
    elif op == "suppress" and topic != "/cmd_vel":
        return f"{topic} does not move this robot"
    elif op == "suppress":
        robot.suppressed = {"until": until, "sources": said.get("sources", []), "by": said.get("by", "")}
    elif topic not in SENSORS:
        return f"there is no {topic}"
    else:
        last = robot.inhibited.get(topic, {}).get("last")
        robot.inhibited[topic] = {
            "until": until,
            "hold": said.get("hold", False),
            "by": said.get("by", ""),
            "last": last,
        }
    every_20_ms()  # zero is said before the answer
    if op in ("stop", "resume"):
        robot.turned = now()
        remember()
    return ""


def safety(left=lambda until: until):
    """What the relay is told whenever it changes."""
    told = {"holder": robot.holder, "moving": bool(robot.v or robot.w), "suppressed": [], "inhibited": []}
    if "stopped" in me:
        told["stopped"] = me["stopped"]
    for kind, lasting in (("suppressed", {"/cmd_vel": robot.suppressed}), ("inhibited", robot.inhibited)):
        for topic, each in lasting.items():
            if now() < each.get("until", 0):
                shown = {name: each[name] for name in ("sources", "hold", "by") if name in each}
                told[kind].append({"resource": topic, "ms": left(each["until"]), **shown})
    return told


def remember():
    """Keep key, relay and stop where a crash does not reach them."""
    new = Path(FILE + ".new")
    new.touch(0o600)
    with new.open("w") as file:
        file.write(json.dumps(me))
        file.flush()
        os.fsync(file.fileno())
    new.replace(FILE)


# 3. Frames: four bytes of length, one of kind, the body


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
        if not 1 <= length <= link.limit or kind not in (0, 1, 5):
            raise ValueError(f"a frame of kind {kind} with {length} bytes breaks the contract")
        if len(link.buffer) < 4 + length:
            return
        body = bytes(link.buffer[5 : 4 + length])
        del link.buffer[: 4 + length]
        if kind == 0:
            yield json.loads(body)
        elif kind == 1:  # nothing here takes samples: what moves takes commands alone
            yield {"op": "sample"}
        else:
            number, stamp, source = struct.unpack_from("!IQI", body)
            yield {"op": "command", "number": number, "stamp": stamp, "source": source, "message": body[16:]}


# 4. The control link: enrol once, prove who we are, say what we are, open channels


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
        remember()
        raise EOFError("enrolled, now to dial again")
    if op == "challenge" and said["relay"] == me["relay"]:
        prove(control, said["nonce"])
    elif op == "welcome":
        robot.heartbeat = min(max(0.1, float(said["heartbeat"])), 60)
        robot.wait, robot.motion_state, control.ping_due = 0.5, None, 0
        describe(control)
    elif op == "open_channel" and len(links) < 10:
        links.append(dial(control.socket.getpeername()[:2], 4 * 1024 * 1024))
        say(links[-1], "join", version=1, ticket=said["ticket"])
    elif op in ("control_grant", "stop", "resume", "suppress", "inhibit"):
        reason = obey(op, said)
        say(control, "order_result", id=said["id"], ok=not reason, reason=reason)
    elif op != "close_channel":  # the relay then hangs up on the channel's own link, too
        if op in ("refused", "challenge"):  # a challenge of another relay: nothing was signed
            seconds = float(said.get("retry_after") or 30)  # without a time only a person can help
            robot.wait = min(max(0.5, 2 * seconds), 3600)
        raise ValueError(f"the relay says {said}")


# 5. Channel links: what clients want


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
    elif op == "command":
        if number in link.commands:
            command(link, said["stamp"], said["source"], said["message"])
    elif op == "call_service" and said["service"] == "/beep":
        say(link, "service_response", id=said["id"], result=True, values={"success": True, "message": "beep"})
    elif op == "call_service":
        say(link, "service_response", id=said["id"], result=False, reason="there is only /beep")
    elif op == "send_action_goal":
        say(link, "action_result", id=said["id"], status=0, result=False, reason="there are no actions")
    elif not op.startswith(("sample", "unadvertise_", "cancel_")):  # these want no answer
        ref = next((str(said[each]) for each in ("number", "service", "action", "type") if each in said), "")
        say(link, "failed", request=op, reference=ref, reason="this small robot does not have that")


def publish(link):
    for number, each in link.subscriptions.items():
        if now() >= each["due"] and select.select([], [link.socket], [], 0)[1]:  # never wait to send a sample
            each["due"] = now() + each["every"]
            sample = json.dumps(SENSORS[each["topic"]][1]()).encode()
            quiet = robot.inhibited.setdefault(each["topic"], {"until": 0})
            if now() >= quiet["until"]:
                quiet["last"] = sample
            elif quiet["hold"] and quiet["last"]:
                sample = quiet["last"]
            else:
                continue
            send(link, 1, struct.pack("!IQ", number, time.time_ns()) + sample)


# 6. Commands: how old can one be, by what the pings say of the relay's clock?


def ahead(link):
    """The relay's clock showed `at` after ours had shown `t`, so it is ahead by no more than `at - t`."""
    return min(at - t + (now() - t) // 1000 for t, at in link.exchanges)


def compare(link, t, at):
    if link.exchanges and ahead(link) < at - now():
        link.exchanges.clear()  # both can't be true: a clock stood still
    link.exchanges.append((t, at))


def command(link, stamp, source, body):
    try:
        twist = json.loads(body)
        speeds = [float(twist.get(part, {}).get(axis, 0)) for part in ("linear", "angular") for axis in "xyz"]
        age = now() + ahead(link) - stamp
        fresh = 0 <= age <= MOTION["deadline_ms"] * MS
        if not obeys(source, any(speeds) or not fresh, now() - max(age, 0)):
            raise ValueError(f"source {source} does not move the robot now")
        if not fresh or not all(map(math.isfinite, speeds)):
            raise ValueError(f"speeds {speeds}, up to {age / SECOND:.3f} s old")
    except Exception as error:
        print(f"a command was dropped: {error}", flush=True)
    else:
        robot.until = now() + (MOTION["stop_within_ms"] - 100) * MS
        robot.v, robot.w, robot.mover = speeds[0], speeds[5], source


# 7. All links in turn, for ever


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
    if link is links[0] and link.ping_due < math.inf and safety() != robot.motion_state:
        robot.motion_state = safety()
        say(link, "motion_state", **safety(lambda until: max(0, until - now()) // MS))
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
        hold(0)
        robot.turned = now()
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
