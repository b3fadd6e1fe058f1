"""Answers the relay's requests about modules and processes, and reports the state of modules."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import NotFound
from robot_client.modules import log_ring
from robot_client.modules.log_ring import LogPage
from robot_client.modules.process_table import ProcessTable
from robot_client.modules.supervisor import ModuleSupervisor, SupervisedModule
from robot_client.twisted_types import DelayedCall, ReactorClock

REPORT_SECONDS = 0.2
"""Changes of modules within this time are reported together."""

LOG_POLL_SECONDS = 0.25
"""Seconds between two reads of a log by a client that waits for its next line."""

LOG_READERS = 16
"""Requests for a log that may wait for a line at the same time."""

InThread = Callable[..., Deferred[Any]]
"""Calls a function with its arguments in a thread; fires with its result."""


@dataclass
class _LogReader:
    """A request that waits for a line.

    :param until: reactor seconds
    :param after: offset from which it reads on; ``None``: reads the newest lines, or those before ``request.before``
    :param missed: whether lines between were no longer on disk
    """

    request: link.ReadModuleLog
    folder: Path
    until: float
    after: int | None
    missed: bool = False


class ModuleRequests:
    """The relay's requests about modules and processes.

    :param folder: holds a folder for each module
    :param send: sends a message to the relay; it is discarded if the robot is not registered
    :param other_roots: processes of the robot beside daemon and modules, by their ids
    :param in_thread: reads files and measures, so that motion does not wait for it
    :param wall: Unix time, seconds
    """

    log = Logger()

    def __init__(
        self,
        supervisor: ModuleSupervisor,
        folder: Path,
        *,
        send: Callable[[link.Message], None],
        clock: ReactorClock,
        in_thread: InThread,
        other_roots: Callable[[], dict[int, str]],
        wall: Callable[[], float],
    ) -> None:
        self._supervisor = supervisor
        self._folder = folder
        self._send = send
        self._clock = clock
        self._in_thread = in_thread
        self._other_roots = other_roots
        self._wall = wall
        self._report: DelayedCall | None = None
        self._readers = 0
        self._table = ProcessTable()
        self._measuring: list[int] = []
        """Requests that wait for the measurement that is being made."""
        supervisor.on_change(self._changed)

    def registered(self) -> None:
        """Report all modules to the relay, which knows nothing yet."""
        self._send_modules()

    def robot_stopped(self, stopped: bool) -> None:
        """Pass on to modules that the robot was stopped or resumed."""
        self._supervisor.robot_stopped(stopped)

    def handle(self, message: link.Message) -> bool:
        """Carry out one message.

        :returns: whether it concerned modules or processes
        """
        if isinstance(message, link.OrderModule):
            self._order(message)
        elif isinstance(message, link.ReadModuleLog):
            self._read_log(message)
        elif isinstance(message, link.MeasureProcesses):
            self._measure(message)
        else:
            return False
        return True

    # --- states and orders --------------------------------------------------------------------------------

    def _changed(self, module: SupervisedModule) -> None:
        if self._report is None:
            self._report = self._clock.callLater(REPORT_SECONDS, self._send_modules)

    def _send_modules(self) -> None:
        if self._report is not None and self._report.active():
            self._report.cancel()
        self._report = None
        self._send(link.Modules(modules=[module_info(each) for each in self._supervisor]))

    def _order(self, order: link.OrderModule) -> None:
        try:
            module = self._supervisor[order.module]
        except NotFound as error:
            self._send(link.ModuleOrdered(request=order.request, error=str(error)))
            return
        self.log.info("{action} {module}, by order of the relay", action=order.action, module=order.module)
        getattr(module, order.action)()
        self._send(link.ModuleOrdered(request=order.request))

    # --- logs ---------------------------------------------------------------------------------------------

    def _read_log(self, request: link.ReadModuleLog) -> None:
        try:
            name = self._supervisor[request.module].name
        except NotFound as error:
            self._send(link.ModuleLog(request=request.request, error=str(error)))
            return
        if request.after is not None and request.before is not None:
            self._send(link.ModuleLog(request=request.request, error="'after' does not go with 'before'"))
            return
        if self._readers >= LOG_READERS:
            text = f"{LOG_READERS} requests for logs wait already, the most this robot takes"
            self._send(link.ModuleLog(request=request.request, error=text))
            return
        self._readers += 1
        wait = 0.0 if request.before is not None else request.wait_s
        until = self._clock.seconds() + wait
        self._read_page(_LogReader(request, self._folder / name / "log", until, request.after))

    def _read_page(self, reader: _LogReader) -> None:
        request = reader.request
        read: Callable[..., LogPage] = log_ring.read_before if reader.after is None else log_ring.read
        offset = request.before if reader.after is None else reader.after
        page = self._in_thread(read, reader.folder, offset, request.most, request.level)
        page.addCallbacks(partial(self._found, reader), partial(self._failed, request))

    def _found(self, reader: _LogReader, page: LogPage) -> None:
        reader.missed |= page.missed
        if not page.lines and self._clock.seconds() < reader.until:
            if reader.after is not None:
                # Lines of other levels are not read again.
                reader.after = page.next
            self._clock.callLater(LOG_POLL_SECONDS, self._read_page, reader)
            return
        self._readers -= 1
        self._send(
            link.ModuleLog(
                request=reader.request.request,
                lines=[link.LogLine(**asdict(each)) for each in page.lines],
                previous=page.previous,
                next=page.next,
                missed=reader.missed,
            )
        )

    def _failed(self, request: link.ReadModuleLog, failure: Failure) -> None:
        self._readers -= 1
        self.log.failure("a module's log could not be read", failure)
        text = f"the log can't be read: {failure.getErrorMessage()}"
        self._send(link.ModuleLog(request=request.request, error=text))

    # --- processes ----------------------------------------------------------------------------------------

    def _measure(self, request: link.MeasureProcesses) -> None:
        self._measuring.append(request.request)
        if len(self._measuring) == 1:
            measured = self._in_thread(self._table.measure, self._roots())
            measured.addCallbacks(self._measured, self._not_measured)

    def _measured(self, found: tuple[list[link.ProcessInfo], int]) -> None:
        for request in self._answered():
            self._send(link.Processes(request=request, at=self._wall(), processes=found[0], more=found[1]))

    def _not_measured(self, failure: Failure) -> None:
        self.log.failure("processes could not be measured", failure)
        for request in self._answered():
            self._send(link.Processes(request=request, at=self._wall(), error=failure.getErrorMessage()))

    def _answered(self) -> list[int]:
        requests, self._measuring = self._measuring, []
        return requests

    def _roots(self) -> dict[int, str]:
        roots = self._other_roots()
        for module in self._supervisor:
            # A runner may have the leftovers of a process that has ended.
            for pid in (module.pid, module.runner_pid):
                if pid is not None:
                    roots[pid] = module.name
        return roots


def module_info(module: SupervisedModule) -> link.ModuleInfo:
    """A module as the relay and local clients see it."""
    return link.ModuleInfo(
        name=module.name,
        kind=module.settings.kind,
        state=module.state.value,
        wanted=module.wanted,
        since=module.since,
        pid=module.pid,
        restarts=module.restarts,
        last_exit=module.last_exit,
        after=module.settings.after,
        why=module.why,
    )
