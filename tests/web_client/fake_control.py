"""Control, stops and alerts of the fake relay's robots, as far as the portal's tests need them."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from typing import Any

Json = dict[str, Any]

LIMITS = {"operator": {"linear": 1.2, "angular": None}, "owner": {}}
ADDRESS = "192.0.2.7:50123"


class Control:
    """Control of one robot. A client has ``user``, ``level`` and ``number``.

    :param changed: called after every change
    """

    def __init__(self, robot: str, changed: Callable[[], None]) -> None:
        self.robot, self.changed = robot, changed
        self.holder: Any = None
        self.request: Any = None
        self.why = ""
        self.since = self.asked = 0.0
        self.grace = 30.0
        self.stopped: Json | None = None
        self.suppressed: list[Json] = []
        self.inhibited: list[Json] = []
        self.implicit = False
        self.away = False
        self.denial = ""
        self.fault = ""
        """What the robot can't do of a stop."""

    def reported(self, client: Any) -> Json:
        """The content of ``/relay/control`` for one client."""
        request = self._person(self.request, client, self.asked)
        if request is not None:
            request |= {"why": self.why, "until": self.asked + self.grace}
        holder = self._person(self.holder, client, self.since)
        if holder is not None:
            holder |= {"implicit": self.implicit}
        return {
            "robot": self.robot,
            "state": "requested" if self.request else "held" if self.holder else "free",
            "holder": holder,
            "request": request,
            "stopped": self.stopped,
            "moving": False,
            "suppressed": self.suppressed,
            "inhibited": self.inhibited,
            "limits": LIMITS,
            "you": {
                "client": client.number,
                "may_control": client.level != "viewer",
                "may_resume": client is self.holder or client.level == "owner",
            },
        }

    def _person(self, whom: Any, client: Any, since: float) -> Json | None:
        if whom is None:
            return None
        return {"user": whom.user, "client": whom.number, "since": since, "you": whom is client}

    def order(self, client: Any, order: str, why: str) -> Json:
        """One of the services below ``/relay/``."""
        success, message = getattr(self, order)(client, why)
        self.changed()
        done = {"done": success and not self.away, "stopped": self.stopped} if order == "stop" else {}
        return {"success": success, "message": message, **done}

    def take_control(self, client: Any, why: str) -> tuple[bool, str]:
        """A free robot is taken. A controlled one is requested, or taken over by an owner who waited long
        enough.
        """
        if client.level == "viewer":
            return False, f"{client.user} may not control {self.robot}"
        if self.denial:
            return False, self.denial
        ripe = self.request is client and time.time() >= self.asked + self.grace
        mine = self.holder is not None and self.holder.user == client.user
        if self.holder is None or mine or ((client.level == "owner" or self.implicit) and ripe):
            self.holder, self.request, self.since = client, None, time.time()
            return True, "you have control"
        if self.request is None:
            self.request, self.why, self.asked = client, why, time.time()
        return False, f"{self.holder.user} has control and was asked for it"

    def release_control(self, client: Any, why: str) -> tuple[bool, str]:
        """Releases control, or withdraws a request."""
        if client is self.request:
            self.request = None
        elif client is self.holder:
            self.holder = self.request = None
        return True, ""

    def grant_control(self, client: Any, why: str) -> tuple[bool, str]:
        """The holder grants it."""
        if client is not self.holder or self.request is None:
            return False, "there is no request for control"
        self.holder, self.request, self.since = self.request, None, time.time()
        return True, ""

    def refuse_control(self, client: Any, why: str) -> tuple[bool, str]:
        """The holder refuses it."""
        if client is not self.holder:
            return False, "you have no control of this robot"
        self.request = None
        return True, ""

    def stop(self, client: Any, why: str) -> tuple[bool, str]:
        """For all users."""
        self.halt(client.user, why, confirmed=not self.away and not self.fault)
        if self.fault:
            return False, f"robot {self.robot} is stopped, but a part of the stop failed: {self.fault}"
        return True, ""

    def halt(self, by: str, why: str = "", *, confirmed: bool = True) -> None:
        """Stops it, or stops it again."""
        order = {"by": by, "why": why, "since": time.time()}
        if self.stopped is None:
            self.stopped = {**order, "confirmed": confirmed, "again": None}
        else:
            self.stopped = {
                **self.stopped,
                "confirmed": self.stopped["confirmed"] or confirmed,
                "again": order,
            }

    def be(self, away: bool) -> None:
        """The robot goes offline or online; when it is back it confirms missed orders."""
        self.away = away
        if self.stopped is not None and not away:
            self.stopped = {**self.stopped, "confirmed": True}
        self.changed()

    def resume(self, client: Any, why: str) -> tuple[bool, str]:
        """For the controller and owners."""
        if client is not self.holder and client.level != "owner":
            return False, "only who has control, or an owner, may resume it"
        self.stopped = None
        return True, ""

    def left(self, client: Any) -> None:
        """A connection has ended."""
        if client in (self.holder, self.request):
            self.release_control(client, "")
            self.changed()

    def rights_changed(self) -> None:
        """A controller without the right loses control."""
        if self.holder is not None and self.holder.level == "viewer":
            self.holder = self.request = None
        self.changed()

    def take_away(self) -> None:
        """Control is lost for any controller."""
        self.holder = self.request = None
        self.changed()


class Alerts:
    """All alerts of the fake relay, by their ids."""

    def __init__(self) -> None:
        self.all: dict[str, Json] = {}
        self._ids = itertools.count(1)

    def put(self, robot: str, text: str, **more: Any) -> str:
        """A new alert, or with ``id`` an update; ``old`` means that the stream no longer has it."""
        id = more.pop("id", None) or str(next(self._ids))
        now = time.time()
        plain = {
            "id": id,
            "robot": robot,
            "kind": "battery",
            "about": "",
            "level": "warning",
            "text": text,
            "first": now,
            "last": now,
            "count": 1,
            "state": "open",
            "over": None,
            "acknowledged": None,
            "may_acknowledge": True,
            "notification_count": 1,
            "notify": True,
        }
        self.all[id] = {**plain, **self.all.get(id, {}), **more}
        return id

    def of(self, robots: list[str]) -> list[Json]:
        """Alerts of some robots, latest first."""
        return sorted((a for a in self.all.values() if a["robot"] in robots), key=lambda a: -a["last"])

    def page(self, robots: list[str], query: Json) -> Json:
        """A page as the relay returns it: with a size limit and a cursor."""
        lasts = {"true": ["open"], "false": ["over"]}.get(query.get("open", ""), ["open", "over"])
        fits = [each for each in self.of(robots) if each["state"] in lasts]
        robot = query.get("robot")
        fits = [each for each in fits if robot in (None, each["robot"])]
        began = int(query.get("before", 0))
        end = began + int(query.get("limit", 100))
        return {"alerts": fits[began:end], "next": str(end) if end < len(fits) else None}

    def streamed(self, robots: list[str]) -> list[Json]:
        """Alerts in the stream, which leaves old ones out."""
        return [alert for alert in self.of(robots) if not alert.get("old")]

    def acknowledge(self, id: str, user: str) -> Json:
        """A user acknowledges it."""
        alert = self.all[id]
        alert |= {"acknowledged": {"by": user, "at": time.time()}, "may_acknowledge": False}
        return alert


def meant(patterns: list[str], robots: list[str]) -> tuple[list[str], list[str]]:
    """The robots selected by a fleet order, and the patterns without a match."""
    means = {each: [robot for robot in robots if fnmatchcase(robot, each)] for each in patterns}
    return sorted(set().union(*means.values())), [each for each, found in means.items() if not found]


def fleet_answer(
    order: Json, robots: list[str], unmatched: list[str], do: Callable[[str], Json]
) -> Iterator[Json]:
    """The lines of the answer to a fleet order.

    :param unmatched: parts of the order without a robot
    :param do: executes it on one robot, and returns the result
    """
    yield {"do": order["do"], "robots": robots, "unmatched": unmatched}
    done = 0
    for robot in robots:
        line = {"ok": True, "message": "", "values": None, "pending": False, "seconds": 0.1, **do(robot)}
        done += line["ok"]
        yield {"robot": robot, **line}
    yield {"done": True, "robots": len(robots), "ok": done, "failed": len(robots) - done, "seconds": 0.3}
