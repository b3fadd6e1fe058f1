"""Recordings of the fake relay (SPEC 1.9): running ones that grow, and those of a test."""

from __future__ import annotations

import time
from typing import Any

Json = dict[str, Any]

FILE = b"\x89MCAP0\r\n" + bytes(range(256)) * 8
PAGE = 100
"""Listed at a time, unless others are asked for."""

SAMPLES = 40
"""Messages a second, of each topic and camera."""


class Refused(Exception):
    """A refused request.

    :param status: of the answer
    """

    def __init__(self, status: int, words: str) -> None:
        super().__init__(words)
        self.status = status


class Recordings:
    """Recordings of all robots, by name."""

    def __init__(self, topics: list[str], cameras: list[str]) -> None:
        self.topics, self.cameras = topics, cameras
        self.of: dict[str, list[Json]] = {}
        self.megabytes = self.left = 10_000.0
        self.refusal = ""
        self.denied = ""
        self.full = ""

    def do(self, order: Json) -> None:
        """An order of a test.

        Known ones: left, megabytes (room), full, refuse (new ones), denied (all), recording (adds one).
        """
        self.left = order.get("left", self.left)
        self.megabytes = order.get("megabytes", self.megabytes)
        self.refusal = order.get("refuse", self.refusal)
        self.denied = order.get("denied", self.denied)
        self.full = order.get("full", self.full)
        if "recording" in order:
            self._add(order["robot"], **order["recording"])

    def answer(
        self, method: str, robot: str, path: str, user: str, level: str, body: Json, query: dict[str, str]
    ) -> tuple[int, Any]:
        """Handles a request; returns status and answer, bytes for a file.

        :raises Refused: with status and text
        """
        here, may = self.of.setdefault(robot, []), level != "viewer" and not self.denied
        if path == "/new":
            return 200, self._possible(may)
        if path == "":
            if method == "POST":
                return 201, self._start(robot, user, may, body)
            return 200, self._page(here if may else [], query)
        id, _, what = path.strip("/").partition("/")
        found = next((each for each in here if each["id"] == id), None)
        if found is None or not may:
            raise Refused(404, "there is no such recording")
        if what == "file":
            return 200, FILE
        if method == "DELETE":
            here.remove(found)
            return 204, None
        if what == "stop":
            self._end(found, f"stopped by {user}")
        return 200, self._look(found)

    def _page(self, listed: list[Json], query: dict[str, str]) -> Json:
        begin = int(query.get("before", 0))
        end = begin + int(query.get("limit", PAGE))
        page = [self._look(each) for each in listed[begin:end]]
        return {"recordings": page, "next": str(end) if end < len(listed) else None}

    def _possible(self, may: bool) -> Json:
        room = {"megabytes": self.megabytes, "left": self.left, "full": self.full}
        if may:
            return {"topics": self.topics, "cameras": self.cameras, "denied": "", **room}
        words = self.denied or "record on /odom needs the level operator; you are viewer on this robot"
        return {"topics": [], "cameras": [], "denied": words, **room}

    def _start(self, robot: str, user: str, may: bool, ask: Json) -> Json:
        if not may:
            raise Refused(403, "record on /odom needs the level operator")
        if self.refusal:
            raise Refused(503, self.refusal)
        return self._look(self._add(robot, user=user, **ask))

    def _add(self, robot: str, **given: Any) -> Json:
        here = self.of.setdefault(robot, [])
        entry = {
            "id": f"r{len(here)}",
            "robot": robot,
            "user": "driver",
            "topics": [],
            "cameras": [],
            "begun": time.time(),
            "ended": None,
            "lasted": None,
            "state": "recording",
            "reason": "",
            "seconds": 600,
            "megabytes": 1000,
            "bytes": 0,
            "messages": 0,
            "drops": 0,
            "problems": [],
            **given,
        }
        here.insert(0, entry)
        return entry

    def _look(self, entry: Json) -> Json:
        if entry["state"] == "recording":
            entry["lasted"] = round(time.time() - entry["begun"], 1)
            entry["messages"] = int(
                entry["lasted"] * SAMPLES * (len(entry["topics"]) + len(entry["cameras"]))
            )
            entry["bytes"] = entry["messages"] * 700
            if entry["lasted"] >= entry["seconds"]:
                self._end(entry, "its time is over")
        return entry

    def _end(self, entry: Json, reason: str) -> None:
        entry |= {"state": "complete", "reason": reason, "ended": time.time()}
