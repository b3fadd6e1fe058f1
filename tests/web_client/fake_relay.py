"""A small fake of the relay: enough HTTP and rosbridge for the portal's own tests, with computed robots.

Run as a script it prints ``READY <port>``. ``POST /fake/do`` changes its behaviour, ``GET /fake/log`` returns
messages of the page. It is no relay: rights are a table, and only publishing and calling are checked.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import functools
import itertools
import json
import math
import mimetypes
import secrets
import time
import types
from collections.abc import Callable, Iterator
from email.utils import formatdate
from fractions import Fraction
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, unquote

import av
import cv2
import fake_navigation
import numpy as np
from fake_control import ADDRESS, Alerts, Control, fleet_answer, meant
from fake_navigation import Navigation
from fake_recordings import Recordings, Refused
from websockets.frames import Opcode
from websockets.protocol import State
from websockets.server import ServerProtocol

Json = dict[str, Any]

PASSWORD = "correct horse"
RIGHTS: dict[str, dict[str, str]] = {
    "admin": {"rover-1": "owner", "rover-2": "owner", "arm-3": "owner"},
    "driver": {"rover-1": "operator", "rover-2": "viewer"},
    "viewer": {"rover-1": "viewer"},
    "newcomer": {},
}
ROBOTS: dict[str, Json] = {
    "rover-1": {
        "description": "Differential drive, laser and camera, in the hall",
        "state": "online",
        "host": "rover-1.lab",
        "platform": "ros2",
        "distro": "jazzy",
    },
    "rover-2": {
        "description": "<img src=x onerror=alert(1)> a robot that sends markup, and a rather long description besides",
        "state": "in_use",
        "host": "<b>bold</b>",
        "platform": "ros2",
        "distro": "kilted",
    },
    "arm-3": {"description": "", "state": "offline", "host": "arm", "platform": "mqtt", "distro": ""},
}
TOPICS = {
    "/battery_state": "sensor_msgs/msg/BatteryState",
    "/camera/image_raw": "sensor_msgs/msg/Image",
    "/camera/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/cmd_vel_nav": "geometry_msgs/msg/Twist",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/odom": "nav_msgs/msg/Odometry",
    "/relay/control": "switchboard_msgs/msg/Control",
    "/relay/status": "switchboard_msgs/msg/Status",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/tf": "tf2_msgs/msg/TFMessage",
}
CAMERAS = {
    "/camera/image_raw": ("sensor_msgs/msg/Image", "rgb8"),
    "/camera/image_raw/compressed": ("sensor_msgs/msg/CompressedImage", "jpeg"),
    "/camera_rear/image_raw/compressed": ("sensor_msgs/msg/CompressedImage", "jpeg"),
}
FRESHNESS = {"Switchboard_Freshness": "1f.0123456789abcdef"}
ORDERS = ("take_control", "release_control", "grant_control", "refuse_control", "stop", "resume")
STREAM = "/api/v1/robots/stream"
CAMERA_SIZE = (640, 480)
CAMERA_RATE = 6.0
LINK = {"rtt_ms": 3.4, "p95_ms": 6.1, "jitter_ms": 0.4, "lost": 0, "quality": "good"}
CSP = (
    "default-src 'self'; img-src 'self' data: blob:; style-src 'self'; connect-src 'self' ws: wss:; "
    "object-src 'none'; base-uri 'none'; frame-ancestors 'none'"
)
PILLARS = [(2.5, 1.0, 0.35), (-1.5, -2.0, 0.5), (1.0, -2.5, 0.3)]
HALL = (4.5, 3.5)
HALF_TURN = np.linspace(-math.pi, math.pi, 360, endpoint=False)


class World:
    """One robot that obeys its last command for half a second."""

    def __init__(self) -> None:
        self.x, self.y, self.heading = -1.0, 0.0, 0.0
        self.speed, self.turn = 0.0, 0.0
        self.commanded = -math.inf
        self.clock = time.monotonic()

    def command(self, twist: Json) -> None:
        self.speed, self.turn = twist["linear"]["x"], twist["angular"]["z"]
        self.commanded = time.monotonic()

    def step(self) -> None:
        now = time.monotonic()
        span, self.clock = min(now - self.clock, 0.2), now
        if now - self.commanded > 0.5:
            self.speed = self.turn = 0.0
        self.heading += self.turn * span
        self.x = float(
            np.clip(self.x + self.speed * math.cos(self.heading) * span, -HALL[0] + 0.3, HALL[0] - 0.3)
        )
        self.y = float(
            np.clip(self.y + self.speed * math.sin(self.heading) * span, -HALL[1] + 0.3, HALL[1] - 0.3)
        )

    def ranges(self, angles: np.ndarray) -> np.ndarray:
        c, s = np.cos(angles + self.heading), np.sin(angles + self.heading)
        with np.errstate(divide="ignore"):
            walls_x = np.where(c > 0, (HALL[0] - self.x) / c, (-HALL[0] - self.x) / c)
            walls_y = np.where(s > 0, (HALL[1] - self.y) / s, (-HALL[1] - self.y) / s)
        # A ray along a wall never meets it; JSON has no infinity.
        best = np.minimum(np.where(c == 0, 99, walls_x), np.where(s == 0, 99, walls_y))
        for px, py, radius in PILLARS:
            along = (px - self.x) * c + (py - self.y) * s
            root = radius**2 - ((px - self.x) ** 2 + (py - self.y) ** 2 - along**2)
            hit = np.where((root > 0) & (along > 0), along - np.sqrt(np.maximum(root, 0)), np.inf)
            best = np.minimum(best, hit)
        return best

    def odom(self) -> Json:
        spin = {"x": 0.0, "y": 0.0, "z": math.sin(self.heading / 2), "w": math.cos(self.heading / 2)}
        none = [0.0] * 36
        return {
            "header": header("odom"),
            "child_frame_id": "base_link",
            "pose": {
                "pose": {"position": {"x": self.x, "y": self.y, "z": 0.0}, "orientation": spin},
                "covariance": none,
            },
            "twist": {
                "twist": {
                    "linear": {"x": self.speed, "y": 0.0, "z": 0.0},
                    "angular": {"x": 0.0, "y": 0.0, "z": self.turn},
                },
                "covariance": none,
            },
        }

    def scan(self) -> Json:
        ranges: list[float | None] = [round(float(r), 3) for r in self.ranges(HALF_TURN)]
        ranges[10:14] = [None] * 4
        return {
            "header": header("laser"),
            "angle_min": -math.pi,
            "angle_max": math.pi,
            "angle_increment": 2 * math.pi / 360,
            "range_min": 0.1,
            "range_max": 12.0,
            "ranges": ranges,
            "intensities": [],
        }

    def picture(self, behind: bool) -> np.ndarray:
        """A camera's image; the rear camera has other colours."""
        angles = np.linspace(0.55, -0.55, 160) + math.pi * behind
        heights = np.clip(190 / (self.ranges(angles) * abs(np.cos(angles))), 4, 239)
        image = np.zeros((480, 640, 3), np.uint8)
        image[:240] = (74, 62, 52)
        image[240:] = (58, 66, 70)
        for i, height in enumerate(heights):
            shade = int(np.clip(60 + height, 60, 235))
            image[240 - int(height) : 240 + int(height), i * 4 : i * 4 + 4] = (
                shade,
                int(shade * 0.9),
                int(shade * 0.75),
            )
        clock = time.strftime("%H:%M:%S") + f".{int(time.time() * 10) % 10}"
        cv2.putText(image, clock, (16, 36), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (235, 235, 235), 2, cv2.LINE_AA)
        return image[:, :, ::-1].copy() if behind else image


def header(frame: str) -> Json:
    now = time.time_ns()
    return {"stamp": {"sec": now // 10**9, "nanosec": now % 10**9}, "frame_id": frame}


class Relay:
    """State shared by all connections, and the tests' changes of it."""

    def __init__(self, portal: Path) -> None:
        self.portal = portal
        self.sessions: dict[str, str] = {}
        self.codes = {"ONCE-ONLY": "admin"}
        self.log: list[Json] = []
        self.sockets: set[Socket] = set()
        self.worlds = {name: World() for name in ROBOTS}
        self.rights = {user: dict(levels) for user, levels in RIGHTS.items()}
        self.robots = {name: dict(robot) for name, robot in ROBOTS.items()}
        self.silent = False
        self.mute = False
        self.frozen = False
        self.dead = False
        self.blind = False
        self.broken = False
        self.unknown = ""
        self.stuck: list[str] = []
        self.unstuck = asyncio.Event()
        self.failing = False
        self.topics = dict(TOPICS)
        self.reduced = 0.0
        self.instead: Json | None = None
        self.ahead = 0.0
        self.kept: float | None = None
        self.source_fps = CAMERA_RATE
        self.last_seen = time.time() - 7200
        self.numbers = itertools.count(1)
        self.controls = {
            name: Control(name, functools.partial(self.control_changed, name)) for name in ROBOTS
        }
        for name, robot in ROBOTS.items():
            self.controls[name].away = robot["state"] == "offline"
        self.alerts = Alerts()
        self.navigation: Navigation | None = None
        self.recordings = Recordings(
            [name for name in TOPICS if not name.startswith("/relay/")], list(CAMERAS)
        )

    @property
    def channels(self) -> list[Channel]:
        return [socket for socket in self.sockets if isinstance(socket, Channel)]

    @property
    def viewings(self) -> list[Viewing]:
        return [socket for socket in self.sockets if isinstance(socket, Viewing)]

    def robot(self, user: str, name: str) -> Json:
        facts = self.robots[name]
        clients = [
            {"user": c.user, "since": int(c.since), "camera": ""} for c in self.channels if c.robot == name
        ]
        if facts["state"] == "in_use":
            clients.append({"user": "ann", "since": int(time.time()) - 300, "camera": "/camera/image_raw"})
        state = facts["state"] if facts["state"] == "offline" or not clients else "in_use"
        there = state != "offline"
        return {
            **facts,
            "name": name,
            "state": state,
            "level": self.rights[user][name],
            "clients": clients,
            "holder": getattr(self.controls[name].holder, "user", None),
            "stopped": self.controls[name].stopped,
            "people": len({each["user"] for each in clients}),
            "suppressed": [],
            "inhibited": [],
            "quality": "good" if there else "lost",
            "battery": 0.76 if there else None,
            "rtt_ms": 4.2 if there else None,
            "last_seen": int(time.time() if there else self.last_seen),
        }

    def control_changed(self, robot: str) -> None:
        for channel in self.channels:
            if channel.robot == robot and "/relay/control" in channel.subscribed:
                channel.tell_control()

    def robot_list(self, user: str) -> Json:
        return {"robots": [self.robot(user, name) for name in self.rights[user]], "next": ""}

    def do(self, order: Json) -> None:
        """An order of a test: close, level, silent (no data), mute (no status), frozen (no answers), say,
        offline, dead (the robot answers no ping), gone (a topic that has ended).

        Of HTTP: stuck (without an answer until they are released: the requests "session" and "orders", and
        "pages", orders by websocket), failing (the session cannot be looked up). Of the stream of pages:
        blind (it sends nothing), broken (there is none), unknown (why it has no data). Of control:
        take_away, stopped (the user; told: whether the robot has received it), resumed, grace (seconds),
        deny (the reason), fault (the failed part of a stop), implicit (whether a command took it),
        suppressed and inhibited (as published). Of navigation, for rover-1: navigation (it has Nav2),
        no_path (there is no path to any goal), waits (it does not drive on while it has reached so many
        targets of its goal). Of alerts: alert, see ``Alerts.put``. Of video: close_video, reduced (a slow
        link), instead (differing parameters of another format), ahead (seconds by which the robot's clock
        is wrong), kept (age in seconds of the only frame for a new viewer; null: there are new ones),
        source_fps. Of recordings: see ``Recordings.do``.
        """
        self.recordings.do(order)
        self.silent = order.get("silent", self.silent)
        self.mute = order.get("mute", self.mute)
        self.frozen = order.get("frozen", self.frozen)
        self.dead = order.get("dead", self.dead)
        self.blind = order.get("blind", self.blind)
        self.broken = order.get("broken", self.broken)
        self.unknown = order.get("unknown", self.unknown)
        self.stuck = order.get("stuck", self.stuck)
        self.unstuck.set()
        self.unstuck = asyncio.Event()
        self.failing = order.get("failing", self.failing)
        if order.get("navigation") and self.navigation is None:
            self.navigation = Navigation(self.worlds["rover-1"], header, HALL)
            self.topics = dict(sorted({**self.topics, **fake_navigation.TOPICS}.items()))
        if self.navigation is not None:
            self.navigation.refuses = order.get("no_path", False)
            self.navigation.waits = order.get("waits")
        self.topics.pop(order.get("gone", ""), None)
        self.reduced = order.get("reduced", self.reduced)
        self.instead = order.get("instead", self.instead)
        self.ahead = order.get("ahead", self.ahead)
        self.kept = order.get("kept", self.kept)
        self.source_fps = order.get("source_fps", self.source_fps)
        if "level" in order:
            self.rights[order["user"]][order["robot"]] = order["level"]
            self.controls[order["robot"]].rights_changed()
        if "state" in order:
            self.robots[order["robot"]]["state"] = order["state"]
            self.controls[order["robot"]].be(away=order["state"] == "offline")
        if "alert" in order:
            self.alerts.put(**order["alert"])
        if "robot" in order:
            control = self.controls[order["robot"]]
            control.grace = order.get("grace", control.grace)
            control.denial = order.get("deny", control.denial)
            control.fault = order.get("fault", control.fault)
            control.implicit = order.get("implicit", control.implicit)
            control.suppressed = order.get("suppressed", control.suppressed)
            control.inhibited = order.get("inhibited", control.inhibited)
            control.changed()
            if "stopped" in order:
                control.halt(order["stopped"], confirmed=order.get("confirmed", True))
                control.changed()
            if order.get("resumed"):
                control.stopped = None
                control.changed()
            if order.get("take_away"):
                control.take_away()
        if order.get("clear_log"):
            self.log.clear()
        for channel in self.channels:
            if "say" in order:
                channel.send({"op": "status", "level": "error", "msg": order["say"], "id": "any"})
            if "close" in order:
                channel.close(order["close"], order.get("reason", ""))
        for viewing in self.viewings:
            if {"reduced", "instead"} & set(order):
                viewing.tell()
            if "close_video" in order:
                viewing.close(order["close_video"], order.get("reason", ""))


class Socket:
    """One websocket of a page."""

    def __init__(
        self, relay: Relay, user: str, robot: str, protocol: ServerProtocol, flush: Callable[[], None]
    ) -> None:
        self.relay, self.user, self.robot = relay, user, robot
        self.protocol, self.flush = protocol, flush
        relay.sockets.add(self)

    def send(self, message: Json) -> None:
        self.protocol.send_text(json.dumps(message, allow_nan=False).encode())
        self.flush()

    def close(self, code: int, reason: str) -> None:
        self.protocol.send_close(code, reason)
        self.flush()

    def take(self, message: Json) -> None:
        raise NotImplementedError  # by the two kinds

    def stream(self, now: float) -> None:
        raise NotImplementedError  # by the two kinds

    def note(self, message: Json) -> None:
        self.relay.log.append({"at": time.monotonic(), "user": self.user, "robot": self.robot, **message})


class Channel(Socket):
    """A rosbridge websocket."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.since = time.time()
        self.number = next(self.relay.numbers)
        self.subscribed: dict[str, set[str]] = {}
        self.due: dict[str, float] = {}

    @property
    def level(self) -> str:
        return self.relay.rights[self.user].get(self.robot, "viewer")

    def take(self, message: Json) -> None:
        op, navigation = message["op"], self.relay.navigation
        self.note(message)
        if op == "subscribe":
            self.subscribed.setdefault(message["topic"], set()).add(message["id"])
            if message["topic"] == "/relay/control":
                self.tell_control()
            elif navigation is not None and message["topic"] in fake_navigation.LATCHED:
                latched = navigation.latched(message["topic"])
                self.send({"op": "publish", "topic": message["topic"], "msg": latched})
        elif op == "unsubscribe":
            ids = self.subscribed.get(message["topic"], set())
            ids.discard(message["id"])
            if not ids:
                self.subscribed.pop(message["topic"], None)
        elif op == "publish" and self.level == "viewer":
            words = f"{self.user} may not publish to {message['topic']}: the level viewer does not allow it"
            self.send({"op": "status", "level": "error", "msg": words, "id": message.get("id")})
        elif op == "publish" and message["topic"] == "/cmd_vel":
            self.relay.worlds[self.robot].command(message["msg"])
        elif op == "call_service":
            self.call(message)
        elif op == "send_action_goal" and navigation is not None:
            navigation.begin(message, self.send)
        elif op == "cancel_action_goal" and navigation is not None:
            navigation.end(fake_navigation.CANCELED)

    def tell_control(self) -> None:
        if not self.relay.frozen:
            reported = self.relay.controls[self.robot].reported(self)
            self.send({"op": "publish", "topic": "/relay/control", "msg": reported})

    def call(self, message: Json) -> None:
        if self.relay.frozen or (self.relay.dead and message["args"].get("robot")):
            return
        values: Json = {}
        service = message["service"].removeprefix("/relay/")
        if service in ORDERS:
            values = self.relay.controls[self.robot].order(self, service, message["args"]["why"])
        if message["service"] == "/rosapi/topics":
            topics = self.relay.topics
            values = {"topics": list(topics), "types": list(topics.values())}
        elif message["service"] == "/relay/ping":
            values = {
                "relay_time_ns": time.time_ns(),
                "robot_rtt_ms": 4.2 if message["args"]["robot"] else None,
            }
        answer = {"op": "service_response", "service": message["service"], "result": True, "values": values}
        self.send({**answer, "id": message["id"]})

    def stream(self, now: float) -> None:
        world = self.relay.worlds[self.robot]
        makers: dict[str, tuple[float, Callable[[], Json]]] = {
            "/odom": (5, world.odom),
            "/scan": (2, world.scan),
            "/battery_state": (1, lambda: {"header": header(""), "percentage": 0.76, "voltage": 24.1}),
            "/relay/status": (1, self.status),
        }
        if self.relay.navigation is not None:
            makers["/tf"] = (5, self.relay.navigation.transforms)
            if self.relay.navigation.goal is not None:
                makers["/plan"] = (5, self.relay.navigation.plan)
        for topic in self.subscribed:
            rate, make = makers.get(topic, (0, dict))
            quiet = self.relay.mute if topic == "/relay/status" else self.relay.silent
            if rate and not quiet and now >= self.due.get(topic, 0):
                self.due[topic] = now + 1 / rate
                self.send({"op": "publish", "topic": topic, "msg": make()})

    def status(self) -> Json:
        facts = self.relay.robot(self.user, self.robot)
        return {
            "robot": self.robot,
            "state": facts["state"],
            "level": facts["level"],
            "clients": facts["clients"],
            "rtt_ms": {"relay_robot": facts["rtt_ms"]},
            "links": dict.fromkeys(("client_relay", "relay_robot", "client_robot"), LINK),
            "people": self.people(),
            "more": 0,
            "drops": 0,
            "video": [
                {"camera": v.camera, "codec": v.codec, "state": "open", "viewers": 1, "width": v.width}
                | {"height": v.height, "quality": v.quality, "fps": v.rate}
                for v in self.relay.viewings
                if v.robot == self.robot
            ],
            "motion": {"topics": ["/cmd_vel"], "types": [], "deadline_ms": 500, "stop_within_ms": 500},
            "health": {"battery": 0.76, "cpu": 0.23, "memory": 0.41, "rtt_ms": 4.2, "stale_commands": 0},
        }

    def people(self) -> list[Json]:
        there: dict[str, Json] = {}
        holder = self.relay.controls[self.robot].holder
        for each in self.relay.channels + self.relay.viewings:
            if each.robot != self.robot:
                continue
            person = there.setdefault(
                each.user,
                {
                    "user": each.user,
                    "you": each.user == self.user,
                    "control": False,
                    "connections": [],
                    "watching": [],
                },
            )
            address = ADDRESS if self.level == "owner" else ""
            if isinstance(each, Viewing):
                person["watching"].append({"camera": each.camera, "since": self.since, "address": address})
                continue
            person["control"] |= each is holder
            facts = {
                "client": each.number,
                "since": each.since,
                "you": each is self,
                "control": each is holder,
            }
            link = {"rtt_ms": 3.4, "robot_rtt_ms": 8.0, "quality": "good", "drops": 0, "address": address}
            person["connections"].append({**facts, **link})
        return list(there.values())


class Viewing(Socket):
    """A camera viewer: one frame under way at a time (SPEC 1.8)."""

    def __init__(self, *given: Any, query: Json) -> None:
        super().__init__(*given)
        self.camera = query["topic"]
        self.width = int(query.get("width", 0)) or CAMERA_SIZE[0]
        self.height = CAMERA_SIZE[1] * self.width // CAMERA_SIZE[0]
        self.quality = int(query.get("quality", 80))
        self.rotate = int(query.get("rotate", 0))
        self.rate = min(float(query.get("fps", 0)) or CAMERA_RATE, CAMERA_RATE)
        self.codec = query.get("codec", "jpeg")
        self.number, self.taken, self.due = 0, 0, 0.0
        self.h264: Any = None
        self.note({"op": "watch", **query})
        self.tell()

    def tell(self) -> None:
        scale = 1 - self.relay.reduced / 2
        facts = {
            "width": int(self.width * scale),
            "height": int(self.height * scale),
            "quality": self.quality,
        }
        more = {
            "fps": self.rate,
            "reduced": self.relay.reduced,
            "delay_ms": 20.0,
            "instead": self.relay.instead,
        }
        self.send(
            {"op": "stream_status", **facts, **more, "encoding": "jpeg", "source_fps": self.relay.source_fps}
        )

    def take(self, message: Json) -> None:
        self.note(message)
        self.taken = message["number"]

    def stream(self, now: float) -> None:
        if self.relay.silent or self.taken != self.number or now < self.due:
            return
        if self.relay.kept is not None and self.number > 0:
            return
        self.due = now + 1 / self.rate
        self.number += 1
        image = self.relay.worlds[self.robot].picture(behind=self.camera.startswith("/camera_rear"))
        image = np.rot90(image, -self.rotate // 90)
        size = (self.width, self.width * image.shape[0] // image.shape[1])
        image = cv2.resize(np.ascontiguousarray(image), size)
        if self.codec == "h264":
            body, key = self.encoded(image)
        else:
            body = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.quality])[1].tobytes()
            key = True
        facts = {
            "number": self.number,
            "stamp": time.time() + self.relay.ahead - (self.relay.kept or 0.0),
            "codec": self.codec,
            "key": key,
        }
        self.send({"op": "frame", **facts, "width": size[0], "height": size[1], "size": len(body)})
        self.protocol.send_binary(body)
        self.flush()

    def encoded(self, image: np.ndarray) -> tuple[bytes, bool]:
        if self.h264 is None:
            self.h264 = av.CodecContext.create("libx264", "w")
            self.h264.width, self.h264.height = image.shape[1], image.shape[0]
            self.h264.pix_fmt, self.h264.time_base = "yuv420p", Fraction(1, 12)
            self.h264.options = {"preset": "ultrafast", "tune": "zerolatency", "profile": "baseline"}
        [packet] = self.h264.encode(av.VideoFrame.from_ndarray(image, format="bgr24"))
        return bytes(packet), packet.is_keyframe


class Connection:
    """One TCP connection: one HTTP request, or a websocket."""

    def __init__(self, relay: Relay, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.relay, self.reader, self.writer = relay, reader, writer
        self.cookies: dict[str, str] = {}
        self.query: dict[str, str] = {}

    async def run(self) -> None:
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            head = await self.reader.readuntil(b"\r\n\r\n")
            lines = head.decode("latin-1").split("\r\n")
            method, target, _ = lines[0].split(" ")
            self.query = dict(parse_qsl(target.partition("?")[2]))
            self.headers = {
                k.lower(): v.strip() for k, _, v in (line.partition(":") for line in lines[1:] if line)
            }
            for part in self.headers.get("cookie", "").split(";"):
                name, _, value = part.strip().partition("=")
                self.cookies[name] = value
            body = await self.reader.readexactly(int(self.headers.get("content-length", 0)))
            if self.headers.get("upgrade", "").lower() == "websocket":
                await self.websocket(head, target)
            else:
                await self.answer(method, target.partition("?")[0], body)
        self.writer.close()

    @property
    def user(self) -> str | None:
        return self.relay.sessions.get(self.cookies.get("session", ""))

    def reply(self, status: int, body: Any = None, kind: str = "application/json", **headers: str) -> None:
        data = body if isinstance(body, bytes) else b"" if body is None else json.dumps(body).encode()
        lines = [
            f"HTTP/1.1 {status} X",
            f"Content-Length: {len(data)}",
            f"Content-Type: {kind}",
            "Connection: close",
            f"Date: {formatdate(usegmt=True)}",
        ]
        lines += [
            f"Content-Security-Policy: {CSP}",
            *(f"{k.replace('_', '-')}: {v}" for k, v in headers.items()),
        ]
        self.writer.write("\r\n".join(lines).encode() + b"\r\n\r\n" + data)

    def problem(self, status: int, detail: str, **headers: str) -> None:
        body = {"type": "about:blank", "title": "Refused", "status": status, "detail": detail}
        self.reply(status, body, "application/problem+json", **headers)

    async def answer(self, method: str, path: str, body: bytes) -> None:
        if path == "/fake/log":
            self.reply(200, self.relay.log)
        elif path == "/fake/do":
            self.relay.do(json.loads(body))
            self.reply(204)
        elif path == "/api/v1/session":
            if method == "GET":
                await self.let_go("session")
            self.session(method, body)
        elif path.startswith("/api/v1/robots/") and "/recordings" in path:
            self.recordings(method, path, body)
        elif path.startswith("/api/v1/"):
            await self.robots(method, path, body)
        elif path.endswith("/video/cameras"):
            self.cameras(path.split("/")[2])
        else:
            self.page(path)

    async def let_go(self, what: str) -> None:
        while what in self.relay.stuck:
            await self.relay.unstuck.wait()

    def session(self, method: str, body: bytes) -> None:
        if method != "GET" and self.headers.get("x-requested-with") != "switchboard":
            self.problem(403, "The header X-Requested-With is missing.")
        elif method == "POST":
            self.login(json.loads(body))
        elif method == "DELETE":
            self.relay.sessions.pop(self.cookies.get("session", ""), None)
            self.reply(204)
        elif self.relay.failing:
            self.problem(503, "The database does not answer.")
        elif self.user is None:
            self.problem(401, "You are not logged in.")
        else:
            self.reply(200, {"user": self.user, "admin": self.user == "admin", "realm": "lab"})

    def login(self, given: Json) -> None:
        user = self.relay.codes.pop(given["code"], None) if "code" in given else given["user"]
        if user == "hasty":
            self.problem(429, "Too many attempts. Wait a little.", Retry_After="30")
        elif user not in self.relay.rights or ("code" not in given and given["password"] != PASSWORD):
            words = (
                "This login link is used up or too old." if "code" in given else "User or password is wrong."
            )
            self.problem(401, words)
        else:
            token = secrets.token_hex(8)
            self.relay.sessions[token] = user
            facts = {"user": user, "admin": user == "admin", "realm": "lab"}
            self.reply(200, facts, Set_Cookie=f"session={token}; HttpOnly; SameSite=Strict; Path=/")

    async def robots(self, method: str, path: str, body: bytes) -> None:
        user, name = self.user, path.removeprefix("/api/v1/robots").strip("/")
        if user is None:
            self.problem(401, "You are not logged in.")
        elif method == "POST":
            await self.let_go("orders")
            self.orders(user, path.removeprefix("/api/v1/").split("/"), json.loads(body or b"{}"))
        elif path == "/api/v1/fleet/groups":
            self.reply(200, {"groups": [{"name": "hall", "robots": ["rover-1"]}]}, **FRESHNESS)
        elif name.endswith("/control"):
            self.reply(200, {"robot": name.partition("/")[0]}, **FRESHNESS)
        elif path == "/api/v1/alerts":
            self.reply(200, self.relay.alerts.page(list(self.relay.rights[user]), self.query))
        elif name == "":
            self.reply(200, self.relay.robot_list(user))
        elif name.endswith("/actions"):
            navigates = self.relay.navigation is not None and name.startswith("rover-1/")
            actions = fake_navigation.ACTIONS if navigates else {}
            type = self.query.get("type", "")
            found = [{"name": each, "types": [actions[each]], "moves": True} for each in actions]
            self.reply(200, {"actions": [each for each in found if type in each["types"]], "next": ""})
        elif name in self.relay.rights[user]:
            self.reply(200, self.relay.robot(user, name))
        else:
            self.problem(404, f"There is no robot '{name}' for you.")

    def orders(self, user: str, parts: list[str], ask: Json) -> None:
        self.relay.log.append({"user": user, "op": "POST " + "/".join(parts), **ask})
        dated = self.headers.get("switchboard-freshness") == FRESHNESS["Switchboard_Freshness"]
        if not dated and (ask.get("do") in ("resume", "call", "set") or parts[-1] == "resume"):
            self.problem(428, "Say when this was sent.")
        elif parts[0] == "alerts":
            self.reply(200, self.relay.alerts.acknowledge(parts[1], user))
        elif parts[0] == "fleet":
            lines = self.fleet_lines(user, ask)
            self.reply(
                200, "".join(f"{json.dumps(line)}\n" for line in lines).encode(), "application/x-ndjson"
            )
        elif (done := self.order(user, parts[1], parts[-1], ask))["ok"]:
            self.reply(202 if done.get("pending") else 200, {})
        elif parts[-1] == "stop":
            self.problem(409, done["message"])
        else:
            self.problem(403, "Only who has control, or an owner, may do that.")

    def fleet_lines(self, user: str, ask: Json) -> Iterator[Json]:
        found = meant(ask["robots"], list(self.relay.rights[user]))
        return fleet_answer(ask, *found, lambda robot: self.order(user, robot, ask["do"], ask))

    def order(self, user: str, robot: str, what: str, ask: Json) -> Json:
        """Executed on one robot for all connections of a user."""
        offline = self.relay.robots[robot]["state"] == "offline"
        if what == "module" and ask["action"] != "restart":
            return {"ok": True, "pending": offline}
        if offline and what != "stop":
            return {"ok": False, "message": "the robot is offline"}
        if what not in ("stop", "resume"):
            return {"ok": True, "values": {"success": True}}
        control = self.relay.controls[robot]
        client = next(
            (c for c in self.relay.channels if c.user == user and c in (control.holder, control.request)),
            None,
        )
        if client is None:
            client = types.SimpleNamespace(user=user, level=self.relay.rights[user][robot], number=0)
        answer = control.order(client, what, ask.get("why", ""))
        return {"ok": answer["success"], "message": answer["message"], "pending": offline}

    def recordings(self, method: str, path: str, body: bytes) -> None:
        robot, _, below = path.removeprefix("/api/v1/robots/").partition("/recordings")
        user, robot = self.user, unquote(robot)
        if user is None or robot not in self.relay.rights[user]:
            self.problem(401 if user is None else 404, f"There is no robot '{robot}' for you.")
            return
        ask = json.loads(body) if body else {}
        if method != "GET":
            self.relay.log.append({"user": user, "robot": robot, "op": f"{method} recordings{below}", **ask})
        level = self.relay.rights[user][robot]
        try:
            status, answer = self.relay.recordings.answer(method, robot, below, user, level, ask, self.query)
        except Refused as error:
            self.problem(error.status, str(error))
            return
        kind = "application/octet-stream" if isinstance(answer, bytes) else "application/json"
        more = {"Content_Disposition": 'attachment; filename="it.mcap"'} if isinstance(answer, bytes) else {}
        self.reply(status, answer, kind, **more)

    def cameras(self, robot: str) -> None:
        if self.user is None or robot not in self.relay.rights[self.user]:
            self.problem(401 if self.user is None else 404, f"There is no robot '{robot}' for you.")
            return
        size = {
            "width": CAMERA_SIZE[0],
            "height": CAMERA_SIZE[1],
            "fps": CAMERA_RATE,
            "seen": None,
            "streams": [],
        }
        cameras = [{"name": n, "type": t, "encoding": e, **size} for n, (t, e) in CAMERAS.items()]
        self.reply(200, {"cameras": cameras})

    def page(self, path: str) -> None:
        file = (self.relay.portal / path.lstrip("/")).resolve()
        if not file.is_file() or self.relay.portal.resolve() not in file.parents:
            file = self.relay.portal / "index.html"
        self.reply(200, file.read_bytes(), mimetypes.guess_type(file.name)[0] or "application/octet-stream")

    async def websocket(self, head: bytes, target: str) -> None:
        if target == STREAM and self.relay.broken:
            self.problem(503, "There is no stream.")
            return
        protocol = ServerProtocol()
        protocol.receive_data(head)
        protocol.send_response(protocol.accept(protocol.events_received()[0]))  # type: ignore[arg-type]
        self.flush(protocol)
        if target == STREAM:
            await self.tell(protocol)
            return
        path, _, query = target.partition("?")
        robot, video, _ = path.removeprefix("/robots/").partition("/video/ws")
        robot, asked = unquote(robot), dict(parse_qsl(query))
        user = self.user
        if user is None or robot not in self.relay.rights[user] or (video and asked["topic"] not in CAMERAS):
            protocol.send_close(4401 if user is None else 4404, "")
            self.flush(protocol)
            return
        given = (self.relay, user, robot, protocol, lambda: self.flush(protocol))
        socket: Socket = Viewing(*given, query=asked) if video else Channel(*given)
        try:
            while data := await self.reader.read(65536):
                protocol.receive_data(data)
                self.flush(protocol)
                for frame in protocol.events_received():
                    # Like the relay, it reads nothing from a connection that it has ended.
                    if getattr(frame, "opcode", None) is Opcode.TEXT and protocol.state is State.OPEN:
                        socket.take(json.loads(frame.data))  # type: ignore[union-attr]
        finally:
            self.relay.sockets.discard(socket)
            self.relay.controls[robot].left(socket)

    async def tell(self, protocol: ServerProtocol) -> None:
        """A page's stream."""
        user = self.user
        self.relay.log.append({"op": "follow", "by": user})
        reading = asyncio.ensure_future(self.read(protocol, user))
        while not reading.done() and not self.relay.broken:
            if user is None or self.user != user:
                protocol.send_close(4401, "your session has ended; log in again")
            elif not self.relay.blind:
                for event, data in self.events(user):
                    protocol.send_text(json.dumps({"event": event, "data": data}).encode())
            self.flush(protocol)
            await asyncio.wait([reading], timeout=0.5)
        reading.cancel()

    def events(self, user: str) -> list[tuple[str, Json]]:
        if self.relay.unknown:
            return [("unknown", {"reason": self.relay.unknown})]
        alerts = {"alerts": self.relay.alerts.streamed(list(self.relay.rights[user]))}
        return [("robots", self.relay.robot_list(user)), ("alerts", alerts)]

    async def read(self, protocol: ServerProtocol, user: str | None) -> None:
        while protocol.state is State.OPEN and (data := await self.reader.read(65536)):
            protocol.receive_data(data)
            for frame in protocol.events_received():
                if getattr(frame, "opcode", None) is Opcode.TEXT and user is not None:
                    await self.let_go("pages")
                    ask = json.loads(frame.data)  # type: ignore[union-attr]
                    self.relay.log.append({"user": user, "op": "page", **ask})
                    for line in self.fleet_lines(user, ask):
                        protocol.send_text(json.dumps({"event": "order", "data": line}).encode())
                    self.flush(protocol)

    def flush(self, protocol: ServerProtocol) -> None:
        for data in protocol.data_to_send():
            if data:
                self.writer.write(data)
            else:
                self.writer.close()


async def stream(relay: Relay) -> None:
    while True:
        await asyncio.sleep(0.02)
        for world in relay.worlds.values():
            world.step()
        if relay.navigation is not None:
            relay.navigation.step(0.02, relay.controls["rover-1"].stopped is not None)
        for socket in list(relay.sockets):
            if socket.protocol.state is State.OPEN and not relay.frozen:
                socket.stream(time.monotonic())


async def main(portal: Path, port: int) -> None:
    relay = Relay(portal)
    server = await asyncio.start_server(lambda r, w: Connection(relay, r, w).run(), "127.0.0.1", port)
    print(f"READY {server.sockets[0].getsockname()[1]}", flush=True)
    await stream(relay)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--portal", type=Path, required=True, help="folder of the built portal")
    parser.add_argument("--port", type=int, default=0)
    options = parser.parse_args()
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(main(options.portal, options.port))
