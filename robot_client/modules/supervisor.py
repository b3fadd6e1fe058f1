"""The supervisor of all modules: it starts, restarts and stops them, by order and by policy.

Decisions are here and in :mod:`robot_client.modules.states`; processes are in :mod:`robot_client.modules.module_run`.
"""

from __future__ import annotations

import enum
import errno
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred, DeferredList, succeed
from twisted.logger import Logger

from relay_protocol.errors import NotFound
from robot_client.alerts import AlertCondition, OnAlert
from robot_client.modules.module_exit import ModuleExit
from robot_client.modules.module_orders import LatestOrder, read_orders, write_orders
from robot_client.modules.module_run import ModuleRun, RunListener
from robot_client.modules.readiness import RobotGraph, check_ready, ready_endpoints
from robot_client.modules.settings import ModuleSettings
from robot_client.modules.states import ModuleEvent, ModuleState, next_state

LONGEST_BACKOFF = 60.0
"""Longest pause before a restart, seconds."""

MOST_DOUBLINGS = 1000
"""The pause doubles so often at most, as there is no float 2**1024."""

READY_POLL = 0.5
"""Seconds between two checks of the graph for a module that starts."""

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors of a disk, a quota or a limit that may accept writes later."""

ORDERS = "orders.json"
"""Name of the file with orders to modules; no module has such a name."""

DAEMON = "daemon"
"""What an alert about no single module is about; no module has this name."""

SAVE_AGAIN_SECONDS = 10.0
"""Orders that can't be saved are saved again after so long."""

NAMED_NODES = 5
"""Most nodes that an alert names."""


class StopCause(enum.Enum):
    """Why a module is being stopped."""

    ORDER = enum.auto()
    """An order, or the end of the daemon."""
    LATE = enum.auto()
    """It was not ready in time, which counts as a crash."""
    LEFTOVERS = enum.auto()
    """Its process has ended by itself, and has left others. The policy decides what follows."""


RUNS = (ModuleState.STARTING, ModuleState.RUNNING, ModuleState.STOPPING)


class SupervisedModule(RunListener):
    """One module: its settings, its state, its run.

    :ivar since: when it entered its state, Unix time, seconds
    :ivar pid: of its process; ``None`` while it does not run
    :ivar restarts: how often it was restarted since the daemon started
    :ivar last_exit: how its latest run ended, in words; empty before that
    """

    log = Logger()

    def __init__(
        self, settings: ModuleSettings, folder: Path, supervisor: ModuleSupervisor, alert: OnAlert
    ) -> None:
        self.settings = settings
        self.state = ModuleState.STOPPED
        self.since = supervisor.wall()
        self.pid: int | None = None
        self.restarts = 0
        self.last_exit = ""
        self.order: LatestOrder | None = None
        """The latest one, if there was any since the machine was started."""
        self._folder = folder
        self._supervisor = supervisor
        self._alert = AlertCondition(alert, "module", settings.name)
        self._run: ModuleRun | None = None
        self._timer: Any = None
        """Of the state: the pause before a restart, or the time within which it must be ready."""
        self._crashes: deque[float] = deque()
        """When it crashed within the last ``within_s``, reactor seconds."""
        self._start_failures = 0
        """How often in a row it could not be started because of the disk."""
        self._endpoints_before: frozenset[bytes] = frozenset()
        """Publishers or servers of what makes it ready, that were there before this run."""
        self._stop_cause = StopCause.ORDER
        self._was_ready = False
        """Whether its latest run was ready, so that modules that wait for it could start."""
        self._fault = ""
        """What its latest run did wrong, as the alert says it, where it was not stopped by an order; else empty."""
        self._start_again = False
        """Whether it is started as soon as it has stopped."""
        self._dead_nodes: dict[str, int] = {}
        """Exit codes of nodes of its launch file, by name."""
        self._unkillable = ""
        """Which of its processes can't be ended, in words; empty if there are none."""
        self._output_loss = ""
        """Why its output is being lost; empty if it is not."""
        self._stop_waiters: list[Deferred[None]] = []

    @property
    def name(self) -> str:
        """Its name."""
        return self.settings.name

    @property
    def wanted(self) -> bool:
        """Whether it is to run, by the latest order or by ``autostart``."""
        return self.settings.autostart if self.order is None else self.order.wanted

    @property
    def why(self) -> str:
        """Why it does not go on, in words; empty if it does."""
        if self._unkillable:
            return f"it can't be ended: {self._unkillable}"
        if self.state is not ModuleState.WAITING:
            return ""
        dependencies = [self._supervisor[name] for name in self.settings.after]
        texts = [each.not_ready_text for each in dependencies if each.state is not ModuleState.RUNNING]
        return f"it waits for {' and '.join(texts)}" if texts else ""

    @property
    def not_ready_text(self) -> str:
        """Its name and why it is not ready, for the modules that wait for it."""
        if self._unkillable:
            text = f"can't be ended: {self._unkillable}"
        elif self.state is ModuleState.STOPPED and not self.wanted:
            text = "autostart = false" if self.order is None else "stopped by an order"
        elif self.state is ModuleState.STOPPED:
            text = f"has ended: {self.last_exit}" if self.last_exit else "not started yet"
        else:
            text = _NOT_READY[self.state].format(exit=self.last_exit)
        return f"{self.name} ({text})"

    @property
    def runner_pid(self) -> int | None:
        """Id of the process beside it, while that runs."""
        return None if self._run is None else self._run.runner_pid

    @property
    def has_current_settings(self) -> bool:
        """Whether it does not run, or was started with its present settings."""
        return self._run is None or self._run.has_settings(self.settings)

    # --- orders -------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Have it run. It changes nothing if it runs already."""
        self._set_wanted(True)
        self.start_for_now()

    def stop(self) -> Deferred[None]:
        """Have it stop. Fires when all its processes have ended, or can't be ended."""
        self._set_wanted(False)
        return self.stop_for_now()

    def restart(self) -> None:
        """Stop it, and start it when it has stopped."""
        self._set_wanted(True)
        self.restart_for_now()

    def start_for_now(self) -> None:
        """Start it without an order to run: the daemon starts."""
        self._forget_crashes()
        if self.state is ModuleState.STOPPING:
            self._start_again, self._stop_cause = True, StopCause.ORDER
        else:
            self._event(ModuleEvent.START)

    def restart_for_now(self) -> None:
        """Restart it without an order to run: its settings have changed."""
        self._forget_crashes()
        if self.state in RUNS:
            self._start_again, self._stop_cause = True, StopCause.ORDER
            self._event(ModuleEvent.STOP)
        else:
            self._event(ModuleEvent.START)

    def stop_for_now(self) -> Deferred[None]:
        """Stop it without an order to stay stopped: the daemon ends, or an adopted module is not wanted."""
        self._start_again, self._stop_cause = False, StopCause.ORDER
        self._fault = ""
        self._event(ModuleEvent.STOP)
        self._update_alert()
        if self.state is ModuleState.STOPPED or self._unkillable:
            return succeed(None)
        done: Deferred[None] = Deferred()
        self._stop_waiters.append(done)
        return done

    # --- events -------------------------------------------------------------------------------------------

    def adopt(self, run: ModuleRun) -> None:
        """Take over a run of an earlier daemon."""
        self._run = run
        # A new daemon does not discover endpoints of processes that were killed before it started.
        self._endpoints_before = frozenset()
        self.robot_stopped(self._supervisor.is_robot_stopped)
        self._set(ModuleState.STARTING)
        self._await_ready()

    def dependencies_changed(self) -> None:
        """Another module has become ready: this one may have waited for it."""
        if self.state is ModuleState.WAITING and self._supervisor.ready(self.settings.after):
            self._event(ModuleEvent.DEPENDENCIES_READY)

    def robot_stopped(self, stopped: bool) -> None:
        """Notify a module that is a Python class whether the robot is stopped."""
        if self._run is not None and self.settings.python:
            self._run.robot_stopped(stopped)

    def on_running(self, pid: int | None) -> None:
        """See :class:`RunListener`."""
        self.pid = pid
        if self._has_ready_check:
            self._supervisor.changed(self)
        else:
            self._event(ModuleEvent.READY)

    def on_ready(self) -> None:
        """See :class:`RunListener`."""
        self._event(ModuleEvent.READY)

    def on_stopping(self) -> None:
        """See :class:`RunListener`."""
        if self.state in (ModuleState.STARTING, ModuleState.RUNNING):
            # An earlier daemon has asked for it, as it ended. That is no order to stay stopped.
            self._start_again = self.wanted
            self._event(ModuleEvent.STOP)

    def on_leftovers(self) -> None:
        """See :class:`RunListener`."""
        self.pid = None
        if self.state in (ModuleState.STARTING, ModuleState.RUNNING):
            self._stop_cause = StopCause.LEFTOVERS
            self._event(ModuleEvent.STOP)

    def on_unkillable(self, reason: str) -> None:
        """See :class:`RunListener`."""
        self._unkillable = reason
        if reason:
            if self.state is not ModuleState.STOPPING:
                self.on_leftovers()
            # The daemon must not wait for it when it ends.
            self._notify_stop_waiters()
        self._update_alert()
        self._supervisor.changed(self)

    def on_dead_nodes(self, nodes: dict[str, int]) -> None:
        """See :class:`RunListener`."""
        self._dead_nodes = nodes
        self._update_alert()

    def on_output_loss(self, reason: str) -> None:
        """See :class:`RunListener`."""
        self._output_loss = reason
        self._update_alert()

    def on_exit(self, exit: ModuleExit) -> None:
        """See :class:`RunListener`."""
        self._dead_nodes = {}
        self._output_loss = self._unkillable = ""
        if exit.stopped:
            self.on_stopping()
        self._run = None
        self.pid = None
        cause, self._stop_cause = self._stop_cause, StopCause.ORDER
        late = cause is StopCause.LATE
        self._cancel()
        if self.state is ModuleState.STOPPING and cause is StopCause.ORDER:
            self.last_exit = str(exit)
            self._event(ModuleEvent.ENDED)
            return
        self._judge(exit, late)
        policy, succeeded = self.settings.restart, exit.succeeded and not late
        if succeeded and policy != "always":
            self._event(ModuleEvent.ENDED)
        elif policy == "never" or self._record_crash():
            if succeeded and not self._fault:
                settings = self.settings
                self.last_exit += (
                    f", more than restarts = {settings.restarts} times in within_s = {settings.within_s:g}"
                )
            self._event(ModuleEvent.FAILED)
        else:
            self._event(ModuleEvent.CRASHED)

    def _judge(self, exit: ModuleExit, late: bool) -> None:
        """Set what the end of a run was that no order has ended."""
        was_ready = self._was_ready or exit.ready or not self._has_ready_check
        missing = "" if was_ready else _missing_text(self.settings)
        if late:
            self.last_exit = f"not ready within ready_within_s = {self.settings.ready_within_s:g}: {missing}"
            self._fault = f"crashed: {self.last_exit}"
        elif not exit.succeeded:
            self.last_exit = str(exit)
            self._fault = f"crashed: {self.last_exit}"
        elif missing:
            # Modules that wait for it would wait in silence.
            self.last_exit = f"{exit} before it was ready: {missing}"
            self._fault = f"ended: {self.last_exit}"
        else:
            self.last_exit = str(exit)
            self._fault = ""

    # --- inside -------------------------------------------------------------------------------------------

    @property
    def _has_ready_check(self) -> bool:
        return bool(self.settings.ready_pattern or self.settings.ready_names)

    def _set_wanted(self, wanted: bool) -> None:
        self.order = LatestOrder(wanted, self.settings.autostart)
        self._supervisor.save_orders()

    def _forget_crashes(self) -> None:
        self._crashes.clear()
        self._start_failures = 0

    def _record_crash(self) -> bool:
        """Count a crash.

        :returns: whether these are too many
        """
        now = self._supervisor.reactor.seconds()
        self._crashes.append(now)
        while self._crashes[0] < now - self.settings.within_s:
            self._crashes.popleft()
        return len(self._crashes) > self.settings.restarts

    def _event(self, event: ModuleEvent) -> None:
        after = next_state(self.state, event)
        if after is not self.state:
            self._set(after)
            self._entered()

    def _set(self, state: ModuleState) -> None:
        self.state = state
        if state is ModuleState.RUNNING:
            self._was_ready, self._fault = True, ""
        self.since = self._supervisor.wall()
        self.log.info("module {name} is {state}", name=self.name, state=state.value)
        self._update_alert()
        self._supervisor.changed(self)

    def _update_alert(self) -> None:
        if self._unkillable:
            self._alert.update(f"module {self.name} can't be ended: {self._unkillable}", "")
        elif self.state is ModuleState.FAILED:
            self._alert.update(f"module {self.name} stays down: {self.last_exit}", "")
        elif self.state in (ModuleState.RUNNING, ModuleState.STOPPED, ModuleState.BACKING_OFF):
            lacking = self._fault or _lacking_text(self._dead_nodes, self._output_loss)
            self._alert.update(
                f"module {self.name} {lacking}" if lacking else "",
                f"module {self.name} is {self.state.value}",
            )

    def _entered(self) -> None:
        state = self.state
        if state is ModuleState.WAITING:
            self.dependencies_changed()
        elif state is ModuleState.STARTING:
            self._begin()
        elif state is ModuleState.RUNNING:
            self._cancel()
            if self._run is not None:
                self._run.save_ready()
        elif state is ModuleState.STOPPING:
            self._cancel()
            assert self._run is not None
            self._run.stop()
        elif state is ModuleState.BACKING_OFF:
            self._timer = self._supervisor.reactor.callLater(self._backoff, self._retry)
        elif state is ModuleState.STOPPED:
            self._cancel()
            self._stopped()

    @property
    def _backoff(self) -> float:
        doublings = min((self._start_failures or len(self._crashes)) - 1, MOST_DOUBLINGS)
        return min(LONGEST_BACKOFF, self.settings.backoff_s * 2.0**doublings)

    def _begin(self) -> None:
        self._was_ready = False
        self._endpoints_before = ready_endpoints(self.settings, self._supervisor.graph)
        try:
            self._run = self._supervisor.start_run(self._folder, self.settings, self)
        except OSError as error:
            self._not_started(error)
            return
        self._start_failures = 0
        self.robot_stopped(self._supervisor.is_robot_stopped)
        self._await_ready()

    def _not_started(self, error: OSError) -> None:
        exit = ModuleExit(error=f"it can't be started: {error.strerror}")
        if error.errno not in DISK_ERRORS:
            self._start_failures = 0
            self.on_exit(exit)
            return
        # No fault of the module, so no crash: it is tried again until its folder can be written.
        self._judge(exit, late=False)
        self._start_failures += 1
        self._event(ModuleEvent.CRASHED)

    def _await_ready(self) -> None:
        if self._has_ready_check:
            self._timer = self._supervisor.reactor.callLater(self.settings.ready_within_s, self._not_ready)
        if self.settings.ready_names:
            self._check_ready(self._run)

    def _check_ready(self, run: ModuleRun | None) -> None:
        if self._run is run and self.state is ModuleState.STARTING:
            ready = check_ready(self.settings, self._supervisor.graph, self._endpoints_before)
            ready.addCallback(self._checked, run)

    def _checked(self, ready: bool, run: ModuleRun | None) -> None:
        """An answer may come late: only that to the run under way counts."""
        if self._run is not run:
            return
        if ready and self.pid is not None:
            self._event(ModuleEvent.READY)
        else:
            self._supervisor.reactor.callLater(READY_POLL, self._check_ready, run)

    def _not_ready(self) -> None:
        self._timer = None
        if self.state is ModuleState.STARTING:
            self._stop_cause = StopCause.LATE
            self._event(ModuleEvent.STOP)

    def _retry(self) -> None:
        self._timer = None
        self.restarts += 1
        self._event(ModuleEvent.RETRY)

    def _stopped(self) -> None:
        self._notify_stop_waiters()
        if self._start_again:
            self._start_again = False
            self.restarts += 1
            self._event(ModuleEvent.START)

    def _notify_stop_waiters(self) -> None:
        waiters, self._stop_waiters = self._stop_waiters, []
        for each in waiters:
            each.callback(None)

    def _cancel(self) -> None:
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None


_NOT_READY = {
    ModuleState.WAITING: "waits too",
    ModuleState.STARTING: "not ready yet",
    ModuleState.STOPPING: "is being stopped",
    ModuleState.BACKING_OFF: "is started again after a pause: {exit}",
    ModuleState.FAILED: "stays down: {exit}",
}
"""What a module does for which another one waits."""


def _missing_text(settings: ModuleSettings) -> str:
    """What a module has not done that would have made it ready."""
    if settings.ready_topic:
        return f"ready_topic = '{settings.ready_topic}' got no new publisher"
    elif settings.ready_service:
        return f"ready_service = '{settings.ready_service}' got no new server"
    elif settings.ready_lifecycle:
        return f"ready_lifecycle = '{settings.ready_lifecycle}' is not active"
    elif settings.ready_log:
        return f"no line of its output matched ready_log = '{settings.ready_log}'"
    return "the start method of its class has not returned"


def _lacking_text(nodes: dict[str, int], output_loss: str) -> str:
    """What is lacking of a module that runs: nodes that have died, or its output; empty if nothing is."""
    lacking = [_dead_nodes_text(nodes)] * bool(nodes) + [output_loss] * bool(output_loss)
    return f"runs {' and '.join(lacking)}" if lacking else ""


def _dead_nodes_text(nodes: dict[str, int]) -> str:
    named = [f"{name} (exit code {code})" for name, code in sorted(nodes.items())]
    more = f" and {len(named) - NAMED_NODES} more" if len(named) > NAMED_NODES else ""
    return f"without nodes that have died: {', '.join(named[:NAMED_NODES])}{more}"


class _RemovedModule(RunListener):
    """Waits for the end of a run whose module the settings no longer have.

    :ivar ended: fires when all its processes have ended, or can't be ended
    """

    def __init__(self, name: str, alert: OnAlert) -> None:
        self.ended: Deferred[None] = Deferred()
        self._name = name
        self._alert = AlertCondition(alert, "module", name)

    def on_running(self, pid: int | None) -> None:
        """See :class:`RunListener`."""

    def on_ready(self) -> None:
        """See :class:`RunListener`."""

    def on_stopping(self) -> None:
        """See :class:`RunListener`."""

    def on_dead_nodes(self, nodes: dict[str, int]) -> None:
        """See :class:`RunListener`."""

    def on_output_loss(self, reason: str) -> None:
        """See :class:`RunListener`."""

    def on_exit(self, exit: ModuleExit) -> None:
        """See :class:`RunListener`."""
        self._set_unkillable("")

    def on_leftovers(self) -> None:
        """See :class:`RunListener`."""

    def on_unkillable(self, reason: str) -> None:
        """See :class:`RunListener`."""
        if reason:
            self._set_unkillable(
                f"module {self._name}, which the settings no longer have, can't be ended: {reason}"
            )

    def _set_unkillable(self, text: str) -> None:
        self._alert.update(text, f"module {self._name} has ended")
        if not self.ended.called:
            self.ended.callback(None)


class ModuleSupervisor:
    """All modules of a robot.

    :param settings: of each module, checked
    :param folder: holds a folder for each module
    :param reactor: Twisted's; starts processes, and is the clock
    :param environment: the daemon's, which modules inherit
    :param graph: the robot's ROS graph, which says that modules are ready
    :param alert: reports crashes
    :param boot: id of this boot of the machine
    :param wall: Unix time, seconds
    """

    def __init__(
        self,
        settings: list[ModuleSettings],
        folder: Path,
        *,
        reactor: Any,
        environment: Mapping[str, str],
        graph: RobotGraph,
        alert: OnAlert,
        boot: str,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self.reactor = reactor
        self.wall = wall
        self.graph = graph
        self.is_robot_stopped = True
        """Whether the robot is stopped, for modules that move it; until it is known, it counts as stopped."""
        self._environment = environment
        self._folder = folder
        self._boot = boot
        self._alert = alert
        self._modules = {
            each.name: SupervisedModule(each, folder / each.name, self, alert) for each in settings
        }
        self._listeners: list[Callable[[SupervisedModule], None]] = []
        self._removed: list[Deferred[None]] = []
        """Ends of runs whose modules the settings no longer have."""
        self._unsaved_orders = AlertCondition(alert, "module", DAEMON)
        self._save_timer: Any = None
        """Saves the orders again, after they could not be saved."""
        self._is_ending = False

    def __iter__(self) -> Iterator[SupervisedModule]:
        return iter(self._modules.values())

    def __getitem__(self, name: str) -> SupervisedModule:
        """A module.

        :raises NotFound: there is none of this name
        """
        found = self._modules.get(name)
        if found is None:
            names = ", ".join(self._modules) or "none"
            raise NotFound(f"the robot has no module '{name}'; it has {names}")
        return found

    def start(self) -> None:
        """Take over what an earlier daemon left running, and start what is to run.

        Modules that left the settings meanwhile are ended first: they may use what a new one opens.
        """
        self._removed = self._stop_removed()
        self._take_orders()
        for module in self:
            run = ModuleRun.reconnect(self.reactor, self._folder / module.name, self._boot, module)
            if run is not None:
                module.adopt(run)
        for module in self:
            if not module.wanted:
                module.stop_for_now()
            elif not module.has_current_settings:
                module.log.info("module {name} is restarted: its settings have changed", name=module.name)
                module.restart_for_now()
        DeferredList(self._removed).addCallback(lambda _: self._start_wanted())

    def _start_wanted(self) -> None:
        for module in self:
            if module.wanted and not self._is_ending:
                module.start_for_now()

    def _stop_removed(self) -> list[Deferred[None]]:
        """Stop what an earlier daemon left running and the settings no longer have."""
        removed = []
        for folder in sorted(each.parent for each in self._folder.glob("*/spec.json")):
            if folder.name not in self._modules:
                listener = _RemovedModule(folder.name, self._alert)
                run = ModuleRun.reconnect(self.reactor, folder, self._boot, listener)
                if run is not None:
                    SupervisedModule.log.info(
                        "module {name} is no longer in the settings and is stopped", name=folder.name
                    )
                    run.stop()
                    removed.append(listener.ended)
        return removed

    def stop(self) -> Deferred[Any]:
        """Stop all modules at the same time, as the daemon ends."""
        self._is_ending = True
        return DeferredList([*self._removed, *(module.stop_for_now() for module in self)], consumeErrors=True)

    def robot_stopped(self, stopped: bool) -> None:
        """The robot was stopped or resumed: notify modules that are Python classes."""
        self.is_robot_stopped = stopped
        for module in self:
            module.robot_stopped(stopped)

    def ready(self, names: list[str]) -> bool:
        """Whether all of these modules are ready."""
        return all(self._modules[name].state is ModuleState.RUNNING for name in names)

    def on_change(self, listener: Callable[[SupervisedModule], None]) -> None:
        """Call ``listener`` with each module whose state has changed."""
        self._listeners.append(listener)

    def changed(self, module: SupervisedModule) -> None:
        """The state of a module has changed."""
        for listener in self._listeners:
            listener(module)
        if module.state is ModuleState.RUNNING:
            for other in self:
                other.dependencies_changed()

    def start_run(self, folder: Path, settings: ModuleSettings, listener: RunListener) -> ModuleRun:
        """Start a run of a module.

        :raises OSError: it can't be started
        """
        return ModuleRun.start(self.reactor, folder, settings, self._environment, self._boot, listener)

    def save_orders(self) -> None:
        """Keep the latest orders, for a daemon that comes after this one in the same boot."""
        orders = {module.name: module.order for module in self if module.order is not None}
        try:
            write_orders(self._folder / ORDERS, self._boot, orders)
        except OSError as error:
            text = "orders to modules can't be saved, and are lost when the daemon ends"
            self._unsaved_orders.update(f"{text}: {error.strerror}", "")
            if self._save_timer is None:
                self._save_timer = self.reactor.callLater(SAVE_AGAIN_SECONDS, self._save_again)
        else:
            self._unsaved_orders.update("", "orders to modules are saved again")

    def _save_again(self) -> None:
        self._save_timer = None
        self.save_orders()

    def _take_orders(self) -> None:
        """Take over the orders to earlier daemons. One holds until ``autostart`` of its module is changed."""
        saved = read_orders(self._folder / ORDERS, self._boot)
        for module in self:
            order = saved.get(module.name)
            if order is not None and order.autostart == module.settings.autostart:
                module.order = saved.pop(module.name)
        if saved:
            # Those that hold no more must not hold again when autostart is changed back.
            self.save_orders()
            SupervisedModule.log.info(
                "orders to {names} hold no more, as the settings have changed", names=", ".join(sorted(saved))
            )
