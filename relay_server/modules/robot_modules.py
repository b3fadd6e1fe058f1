"""The modules of each robot as the relay knows them, and requests about them that a robot has not answered yet."""

from __future__ import annotations

import itertools
import math
import secrets
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred, DeferredLock, fail
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.modules.cpu_shares import CpuShares
from relay_server.modules.schemas import FASTEST_SECONDS, LogQuery, ProcessList
from relay_server.robots.registry import RobotState

ANSWER_SECONDS = 5.0
"""Time for an answer of a robot, beside the time that it was asked to wait."""

MAX_PENDING = 64
"""Most requests to one robot without an answer."""

LATEST_SECONDS = 1.0
"""Seconds between two measurements for ``/relay/processes``."""

KEEP_WATCHING_SECONDS = 3.0
"""The latest measurement is kept up to date for so long after it was asked for."""

FIRST_NUMBERS = 1 << 30
"""The first request number is random up to this: a robot may still answer requests of an earlier relay process."""

NO_PROCESSES = ProcessList(at=0.0, processes=[], more=0)

Answer = link.ModuleOrdered | link.ModuleLog | link.Processes
OnProcesses = Callable[[ProcessList], None]


class NotOrdered(SwitchboardError):
    """The robot could not do what was asked; its words say why."""

    code = "not_ordered"
    http_status = 409


class RequestUnanswered(Unavailable):
    """The robot is offline, or did not answer in time; it may have received the request.

    :ivar late: fires with the answer if it still comes, which needs the same connection
    """

    def __init__(self, message: str, late: Deferred[Answer] | None = None) -> None:
        super().__init__(message)
        self.late: Deferred[Answer] = Deferred() if late is None else late


class _Pending(NamedTuple):
    answer: Deferred[Any]
    timeout: Timer


class ProcessWatch:
    """One client that watches processes.

    :param every: seconds between two measurements
    """

    def __init__(self, every: float, on_processes: OnProcesses) -> None:
        self.every = every
        self.on_processes = on_processes
        self.due = -math.inf
        self._shares = CpuShares()

    def measured(self, found: link.Processes) -> None:
        """Pass on a measurement, with the shares of a CPU since the one that this client got before."""
        self.on_processes(self._shares.measured(found))


class RobotModules:
    """The modules of one robot.

    :ivar modules: as the robot reported them last; they stay while it is offline
    :ivar reported: whether the robot has reported them since it registered
    :ivar reported_at: Unix time at which they were last known to be so: of the latest report, or of the last sign of
        the robot over the connection on which it came; ``None`` if it has never reported any
    :ivar order_lock: held while an order is stored and sent, so that the robot gets orders as they are stored
    """

    def __init__(self, robot: RobotState, registry: ModuleRegistry) -> None:
        self.robot = robot
        self.modules: tuple[link.ModuleInfo, ...] = ()
        self.reported = False
        self.reported_at: float | None = None
        self.order_lock = DeferredLock()
        self._registry = registry
        self._clock = registry.clock
        self._numbers = itertools.count(secrets.randbelow(FIRST_NUMBERS) + 1)
        self._pending: dict[int, _Pending] = {}
        self._late: dict[int, Deferred[Answer]] = {}
        """The latest requests whose answer did not come in time."""
        self._watches: list[ProcessWatch] = []
        self._next: Timer | None = None
        self._measuring = False
        self._listeners: list[Callable[[], None]] = []
        self._latest = NO_PROCESSES
        self._end_latest: Callable[[], None] | None = None
        self._latest_timer: Timer | None = None
        robot.observers.append(self)

    def restore(self, modules: Iterable[link.ModuleInfo], at: float) -> None:
        """Take a stored report, if it is newer than what is known.

        :param at: Unix time of the report, seconds
        """
        if not self.reported and (self.reported_at is None or at > self.reported_at):
            self.modules, self.reported_at = tuple(modules), at

    # --- requests -----------------------------------------------------------------------------------------

    def order(self, module: str, action: link.ModuleAction) -> Deferred[link.ModuleOrdered]:
        """Order a module to be started, stopped or restarted.

        :returns: fires when the robot has accepted the order. Fails with :class:`NotOrdered` when it can't
            carry it out, with :class:`RequestUnanswered` when it is offline, does not answer in time or its connection
            ends before, with :class:`Unavailable` when it has reported no modules or has too many requests to answer
        """
        return self._request(lambda number: link.OrderModule(request=number, module=module, action=action))

    def check_reported(self) -> None:
        """:raises NotOrdered: the robot is online and has reported no modules, so it can't take orders to them"""
        if self.robot.control_link is not None and not self.reported:
            raise NotOrdered(self._no_report())

    def _no_report(self) -> str:
        return f"robot {self.robot.name} has reported no modules since it connected; its program may supervise none"

    def read_log(self, module: str, query: LogQuery) -> Deferred[link.ModuleLog]:
        """Read lines of a module's log; see :class:`relay_protocol.link.ReadModuleLog`.

        :returns: fails as :meth:`order` does
        """
        return self._request(
            lambda number: link.ReadModuleLog(
                request=number,
                module=module,
                after=query.after,
                before=query.before,
                level=query.level,
                most=query.limit,
                wait_s=query.wait,
            ),
            query.wait,
        )

    def measure(self) -> Deferred[link.Processes]:
        """Measure all processes of the robot once.

        :returns: fails as :meth:`order` does
        """
        return self._request(lambda number: link.MeasureProcesses(request=number))

    def watch(self, every: float, on_processes: OnProcesses) -> Callable[[], None]:
        """Measure processes again and again, while the robot is online.

        The robot measures at the shortest interval of all watches; each gets what is due for it.

        :param every: seconds, :data:`FASTEST_SECONDS` or more
        :returns: a function that ends this
        """
        watch = ProcessWatch(every, on_processes)
        self._watches.append(watch)
        self._schedule()

        def end() -> None:
            if watch in self._watches:
                self._watches.remove(watch)
            if not self._watches:
                self._cancel_measurement()

        return end

    def latest_processes(self) -> ProcessList:
        """The latest measurement. Asking keeps it up to date for some seconds; at first there are no processes."""
        cancel(self._latest_timer)
        self._latest_timer = self._clock.callLater(KEEP_WATCHING_SECONDS, self._forget_latest)
        if self._end_latest is None:
            self._end_latest = self.watch(LATEST_SECONDS, self._keep_latest)
        return self._latest

    def _keep_latest(self, found: ProcessList) -> None:
        self._latest = found

    def _forget_latest(self) -> None:
        end, self._end_latest, self._latest_timer = self._end_latest, None, None
        self._latest = NO_PROCESSES
        if end is not None:
            end()

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call ``listener`` when the modules or the robot's availability have changed.

        :returns: a function that ends this
        """
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def changed(self) -> None:
        """Call the listeners."""
        for listener in list(self._listeners):
            listener()

    def _request(self, make: Callable[[int], link.Message], seconds: float = 0.0) -> Deferred[Any]:
        control, name = self.robot.control_link, self.robot.name
        if control is None:
            return fail(RequestUnanswered(f"robot {name} is {self.robot.absence}"))
        if not self.reported:
            # Robots of others may know nothing of modules; a request would wait for its timeout.
            return fail(Unavailable(self._no_report()))
        if len(self._pending) >= MAX_PENDING:
            return fail(Unavailable(f"robot {name} has {MAX_PENDING} requests to answer already"))
        number = next(self._numbers) % (1 << 32)
        answer: Deferred[Any] = Deferred(lambda _: self._forget(number))
        timeout = self._clock.callLater(seconds + ANSWER_SECONDS, self._timed_out, number)
        self._pending[number] = _Pending(answer, timeout)
        control.send(make(number))
        return answer

    def _forget(self, number: int) -> None:
        pending = self._pending.pop(number, None)
        if pending is not None:
            cancel(pending.timeout)

    def _timed_out(self, number: int) -> None:
        pending = self._pending.pop(number)
        late: Deferred[Answer] = Deferred()
        self._late[number] = late
        if len(self._late) > MAX_PENDING:
            del self._late[next(iter(self._late))]
        pending.answer.errback(RequestUnanswered(f"robot {self.robot.name} did not answer in time", late))

    # --- messages of the robot ----------------------------------------------------------------------------

    def message_received(self, message: link.Modules | Answer) -> None:
        """Take a report, or an answer; an answer without a request has no effect."""
        if isinstance(message, link.Modules):
            first, self.reported = not self.reported, True
            self.modules = tuple(message.modules)
            self.reported_at = self._registry.wall()
            self._registry.store_report(self)
            self._registry.on_report(self, first)
            self.changed()
            return
        pending = self._pending.pop(message.request, None)
        if pending is None:
            late = self._late.pop(message.request, None)
            if late is not None:
                late.callback(message)
            return
        cancel(pending.timeout)
        if message.error:
            pending.answer.errback(NotOrdered(f"robot {self.robot.name}: {message.error}"))
        else:
            pending.answer.callback(message)

    # --- RobotObserver ------------------------------------------------------------------------------------

    def robot_online(self) -> None:
        """See :class:`relay_server.robots.registry.RobotObserver`."""
        self._schedule()
        self.changed()

    def robot_offline(self) -> None:
        """See :class:`relay_server.robots.registry.RobotObserver`."""
        if self.reported:
            # Not the time of now: a robot that has connected elsewhere may have been noticed late.
            self.reported_at = max(self.reported_at or 0.0, self.robot.last_seen or 0.0)
            self._registry.store_report(self)
        self.reported = False
        self._cancel_measurement()
        pending, self._pending = self._pending, {}
        self._late.clear()
        for each in pending.values():
            cancel(each.timeout)
            each.answer.errback(
                RequestUnanswered(f"robot {self.robot.name} lost its connection before it answered")
            )
        self.changed()

    def graph_changed(self) -> None:
        """See :class:`relay_server.robots.registry.RobotObserver`."""

    def described(self) -> None:
        """See :class:`relay_server.robots.registry.RobotObserver`."""

    # --- measurements -------------------------------------------------------------------------------------

    def _schedule(self) -> None:
        """Measure when the next watch is due; only one measurement is under way at a time."""
        self._cancel_measurement()
        if self._watches and not self._measuring and self.robot.control_link is not None:
            due = min(each.due for each in self._watches)
            self._next = self._clock.callLater(max(0.0, due - self._clock.seconds()), self._measure)

    def _cancel_measurement(self) -> None:
        cancel(self._next)
        self._next = None

    def _measure(self) -> None:
        self._next = None
        self._measuring = True
        began = self._clock.seconds()
        self.measure().addCallbacks(self._measured, self._not_measured, callbackArgs=(began,))

    def _measured(self, found: link.Processes, began: float) -> None:
        self._measuring = False
        for watch in list(self._watches):
            # Watches that are due soon get this one too, so that intervals stay in step.
            if watch.due - began < FASTEST_SECONDS / 2:
                watch.due = began + watch.every
                watch.measured(found)
        self._schedule()

    def _not_measured(self, failure: Failure) -> None:
        self._measuring = False
        for watch in self._watches:
            watch.due = self._clock.seconds() + max(watch.every, 1.0)
        self._schedule()


class ModuleRegistry:
    """The modules of all robots that have reported some or were asked for.

    :param wall: Unix time, seconds
    :ivar on_report: called with the modules of a robot that has reported them, and whether for the first time since it
        registered
    :ivar store_report: stores modules whose states or whose time have changed
    """

    def __init__(self, clock: Clock, wall: Callable[[], float]) -> None:
        self.on_report: Callable[[RobotModules, bool], None] = lambda modules, first: None
        self.store_report: Callable[[RobotModules], None] = lambda modules: None
        self.clock = clock
        self.wall = wall
        self._robots: dict[int, RobotModules] = {}
        self._restored: dict[int, tuple[Sequence[link.ModuleInfo], float]] = {}

    def of(self, robot: RobotState) -> RobotModules:
        """The modules of a robot."""
        former = self._robots.get(robot.robot_id)
        if former is not None and former.robot is robot:
            return former
        found = self._robots[robot.robot_id] = RobotModules(robot, self)
        if former is not None and former.reported_at is not None:
            found.restore(former.modules, former.reported_at)
        restored = self._restored.pop(robot.robot_id, None)
        if restored is not None:
            found.restore(*restored)
        return found

    def restore(self, robot_id: int, modules: Sequence[link.ModuleInfo], at: float) -> None:
        """Take a stored report; see :meth:`RobotModules.restore`."""
        known = self._robots.get(robot_id)
        if known is None:
            self._restored[robot_id] = (modules, at)
        else:
            known.restore(modules, at)
