"""The rules of pipes: who may add, start, stop and see them, and which run now."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import msgspec
from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred, DeferredLock
from twisted.logger import Logger

from relay_db import queries
from relay_db.names import full_name_of
from relay_db.queries import PipeRecord, RobotRecord, UserRecord
from relay_db.queries.pipes import NewPipeRow
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.realms import full_name, split_name
from relay_server.access import Principal
from relay_server.cluster.homes import RobotHomes, SingleHome
from relay_server.cluster.relays import RelayInfo
from relay_server.common.clock import Clock, PeriodicTimer, PeriodicTimers
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import Buckets
from relay_server.events.bus import BusEvent, EventBus
from relay_server.icpi.programs import ProgramRegistry, PublishedValue
from relay_server.pipes.cycles import PipeEdge, end_key, find_cycle
from relay_server.pipes.fields import steps_of
from relay_server.pipes.program_end import message_of
from relay_server.pipes.running_pipe import PipePort, PipeReply, RunningPipe, check_service
from relay_server.pipes.schemas import NewPipe, PipeEnd, PipeList, PipeSettings, PipeState, PipeStatus
from relay_server.sessions.manager import SessionManager

CHECK_SECONDS = 0.25
"""Seconds between checks of what pipes wait for."""

OPEN_SECONDS = 2.0
"""Seconds between attempts to open pipes that could not be opened."""

MAX_POLLS = 50.0
"""Most calls a second of a service or program that is a source."""

PING_SECONDS = 0.1
"""Seconds between pings to the source robots of pipes that move a robot."""

CHANGES_PER_SECOND = 5.0
CHANGES_BURST = 50.0
MAX_USERS = 1000
"""Changes by one user, each of which is written into the audit log, and users that are counted."""


ELSEWHERE = "waiting for the relay that its target robot is connected to"
"""Why a pipe waits, as another relay of the cluster than that of its target robot knows it."""


_OF_ROLES = re.compile(r"role-[0-9]+-[0-9]+\Z")
"""Names that a Role gives to the pipes of its mappings."""


class PipeCycle(Refused):
    """A pipe would feed itself."""

    code = "cycle"
    http_status = 409


class PipeUser(NamedTuple):
    """A user, or the command line on the relay's machine.

    :param user_id: ``None`` for the command line
    :param realm: ``None`` for all realms
    :param all: whether the pipes of other users are theirs too
    :param actor: as in the audit log
    """

    user_id: int | None
    realm: str | None
    all: bool
    actor: str
    address: str


def pipe_user(principal: Principal, address: str) -> PipeUser:
    """:raises Refused: the token has a scope; pipes outlast tokens, and concern several robots"""
    principal.require_full_scope()
    return PipeUser(principal.user_id, principal.realm, principal.admin, f"user:{principal.full}", address)


def local_pipe_user(by: str) -> PipeUser:
    """The command line on the relay's machine, which may do everything.

    :param by: user of the operating system
    """
    return PipeUser(None, None, True, f"cli:{by}", "local")


class PipeService:
    """
    :param clock_ns: monotonic nanoseconds
    :param wall: Unix time in seconds
    :param homes: of robots. A pipe runs at the home of its target robot
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        sessions: SessionManager,
        database: AsyncDatabase,
        bus: EventBus,
        programs: ProgramRegistry,
        *,
        clock_ns: Callable[[], int],
        wall: Callable[[], float],
        homes: RobotHomes,
    ) -> None:
        self._clock = clock
        self._homes = homes
        self._sessions = sessions
        self._database = database
        self._bus = bus
        self._programs = programs
        self._clock_ns = clock_ns
        self._wall = wall
        self._timers = PeriodicTimers(clock)
        self._running: dict[int, RunningPipe] = {}
        self._unopened: dict[int, PipeRecord] = {}
        """Pipes that are to run, and have no sessions yet."""
        self._opening: set[int] = set()
        self._changing: Counter[int] = Counter()
        """Pipes that are being started, stopped or removed here, by the number of such changes."""
        self._locks: dict[int, DeferredLock] = {}
        self._changed = 0
        """How many pipes were started, stopped, removed or ended here."""
        self._changes = Buckets(CHANGES_PER_SECOND, CHANGES_BURST, MAX_USERS, clock.seconds)
        self._timer_list = [
            PeriodicTimer(self._check_all, CHECK_SECONDS),
            PeriodicTimer(self._open_all, OPEN_SECONDS),
            PeriodicTimer(self._ping_all, PING_SECONDS),
        ]
        self._leaving = False
        bus.subscribe(self._on_event)
        programs.on_value = self._on_value

    # --- the relay ----------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Open the pipes that were running when the relay stopped. None begins to move a robot."""
        for record in await self._database.read(queries.list_pipes):
            if record.enabled:
                self._unopened[record.id] = record
        for timer in self._timer_list:
            self._timers.start(timer)

    def leave(self, reason: str) -> None:
        """The relay shuts down; pipes go on when it is back."""
        self._leaving = True
        for timer in self._timer_list:
            timer.stop()
        running, self._running = self._running, {}
        for each in running.values():
            each.close()

    # --- users --------------------------------------------------------------------------------------------

    async def pipes(self, user: PipeUser) -> PipeList:
        """The user's pipes; for an administrator all of the realm."""
        records = await self._database.read(queries.list_pipes)
        return PipeList([self._status(each) for each in records if _may_see(user, each)])

    async def pipe(self, user: PipeUser, name: str) -> PipeStatus:
        """One pipe.

        :raises NotFound: there is none of this name, or it is another user's
        """
        return self._status(await self._find(user, name))

    async def add(
        self, user: PipeUser, new: NewPipe, owner: str = "", *, counted: bool = True, fresh: bool = True
    ) -> PipeStatus:
        """Add a pipe, and start it if that is wanted.

        :param owner: full name of its owner, for the command line
        :param counted: whether it counts as a change of the user; a Role that is started counts itself
        :param fresh: whether the owner asks for it now, so that it may begin to move a robot
        :raises NotFound: no such robot, or no right on it
        :raises Invalid: the settings can't be used, or the name is taken
        :raises Refused: it would feed itself; too many pipes
        """
        if counted:
            self._count(user)
            if _OF_ROLES.match(new.name):
                raise Invalid(f"names such as {new.name} are for the pipes of Roles; choose another name")
        _check_settings(new)
        record = await self._database.write(self._add, user, new, owner)
        if not new.start:
            return self._status(record)
        try:
            return await self._start(
                user, full_name(record.name, record.realm) if user.realm is None else new.name, fresh
            )
        except PipeCycle:
            await self._database.write(self._remove, user, record)
            raise

    async def start_pipe(self, user: PipeUser, name: str) -> PipeStatus:
        """Start a pipe. One that runs or waits goes on.

        :raises NotFound: there is none of this name, or it is another user's
        :raises Refused: it would feed itself
        """
        self._count(user)
        return await self._start(user, name)

    async def _start(self, user: PipeUser, name: str, fresh: bool = True) -> PipeStatus:
        record = await self._find(user, name)
        if user.user_id is not None and user.user_id != record.owner_id:
            raise Refused(
                f"pipe '{record.name}' runs by the rights of {record.owner}, so only they may start it"
            )
        if record.id in self._running:
            return self._status(record)
        async with self._changing_alone(record):
            await self._database.write(self._enable, user, record)
            record = record._replace(enabled=True, reason="")
            self._unopened[record.id] = record
        await self._open(record, fresh=fresh)
        return self._status(await self._find(user, name))

    async def stop_pipe(self, user: PipeUser, name: str) -> PipeStatus:
        """Stop a pipe.

        :raises NotFound: there is none of this name, or it is another user's
        """
        record = await self._find(user, name)
        # At once, and again when a start that was under way has gone on.
        self._close(record)
        async with self._changing_alone(record):
            await self._database.write(self._disable, user, record)
            self._close(record)
        return self._status(record._replace(enabled=False, reason=""))

    async def remove(self, user: PipeUser, name: str) -> None:
        """Stop and remove a pipe.

        :raises NotFound: there is none of this name, or it is another user's
        """
        record = await self._find(user, name)
        self._close(record)
        async with self._changing_alone(record):
            await self._database.write(self._remove, user, record)
            self._close(record)

    @asynccontextmanager
    async def _changing_alone(self, record: PipeRecord) -> AsyncIterator[None]:
        """Changes of one pipe follow each other. Meanwhile it is not opened by what the database says."""
        with self._while_changing(record):
            lock = self._locks.setdefault(record.id, DeferredLock())
            await lock.acquire()
            try:
                yield
            finally:
                lock.release()

    @contextmanager
    def _while_changing(self, record: PipeRecord) -> Iterator[None]:
        """The pipe is not opened by what the database says meanwhile."""
        self._changing[record.id] += 1
        try:
            yield
        finally:
            self._changing[record.id] -= 1
            if not self._changing[record.id]:
                del self._changing[record.id]
                self._locks.pop(record.id, None)
            self._changed += 1

    async def relay_of(self, user: PipeUser, name: str) -> RelayInfo | None:
        """The other relay of the cluster that a pipe runs at; ``None``: this one, or none now.

        :raises NotFound: there is none of this name, or it is another user's
        """
        return self._homes.elsewhere((await self._find(user, name)).target_robot_id)

    async def relay_of_new(self, user: PipeUser, new: NewPipe, owner: str) -> RelayInfo | None:
        """The same for a pipe that is to be added.

        :param owner: as of :meth:`add`
        :raises NotFound: no such robot, or no right on it
        """
        _, _, robots = await self._database.read(_ends_of, user, new, owner)
        return self._homes.elsewhere(robots[1].id)

    async def _find(self, user: PipeUser, name: str) -> PipeRecord:
        wanted, realm = (name, user.realm) if user.realm is not None else split_name(full_name_of(name))
        for record in await self._database.read(queries.list_pipes):
            if record.name == wanted and record.realm == realm and _may_see(user, record):
                return record
        raise NotFound(f"there is no pipe '{name[:64]}'")

    def _count(self, user: PipeUser) -> None:
        if user.user_id is not None and not self._changes.take(user.user_id):
            raise Unavailable("you change pipes too often; try again in a moment")

    # --- the database -------------------------------------------------------------------------------------

    def _add(self, s: Session, user: PipeUser, new: NewPipe, owner: str) -> PipeRecord:
        owner_id, accounts, robots = _ends_of(s, user, new, owner)
        ends = zip((new.source, new.target), robots, strict=True)
        first, second = (end_key(end, robot.id, owner_id) for end, robot in ends)
        if first == second:
            raise Invalid(f"source and target are the same {'service' if new.source.service else 'topic'}")
        settings = PipeSettings(source=new.source, target=new.target, fields=new.fields, rate=new.rate)
        record = queries.add_pipe(
            s,
            NewPipeRow(
                name=new.name,
                owner_id=owner_id,
                source_robot_id=robots[0].id,
                source_account_id=accounts[0].id,
                target_robot_id=robots[1].id,
                target_account_id=accounts[1].id,
                settings=msgspec.json.encode(settings).decode(),
                enabled=False,
            ),
        )
        self._audit(s, user.actor, "pipe.add", record, user.address)
        return record

    def _enable(self, s: Session, user: PipeUser, record: PipeRecord) -> None:
        others = [
            _edge(each, shown=_may_see(user, each))
            for each in queries.list_pipes(s)
            if each.enabled and each.id != record.id
        ]
        cycle = find_cycle(_edge(record), others)
        if cycle:
            raise PipeCycle(
                f"pipe '{record.name}' would feed itself ({' → '.join(cycle)} → {cycle[0]}); give one of them a rate"
            )
        new = queries.enable_pipe(s, record.id, True)
        if new is None:
            raise NotFound(f"there is no pipe '{record.name}'")
        if new:
            self._audit(s, user.actor, "pipe.start", record, user.address)

    def _disable(self, s: Session, user: PipeUser, record: PipeRecord) -> None:
        if queries.enable_pipe(s, record.id, False):
            self._audit(s, user.actor, "pipe.stop", record, user.address)

    def _remove(self, s: Session, user: PipeUser, record: PipeRecord) -> None:
        if queries.remove_pipe(s, record.id):
            self._audit(s, user.actor, "pipe.remove", record, user.address)

    def _note_end(self, s: Session, record: PipeRecord, reason: str, moves: bool) -> None:
        if queries.enable_pipe(s, record.id, False, reason=reason, moves=moves):
            self._audit(s, "relay", "pipe.end", record, "", why=reason)

    def _audit(
        self, s: Session, actor: str, action: str, record: PipeRecord, address: str, **data: Any
    ) -> None:
        settings = settings_of(record)
        ends = {"from": settings.source.address, "to": settings.target.address}
        target = full_name(record.name, record.realm)
        queries.append_audit(
            s,
            at=self._wall(),
            actor=actor,
            action=action,
            target=target,
            origin=address,
            data={**ends, **data},
        )

    # --- pipes that run -----------------------------------------------------------------------------------

    async def _open(self, record: PipeRecord, *, fresh: bool) -> None:
        """Open the sessions of a pipe. What can't be opened now is tried again, and then is not fresh any more."""
        if record.id in self._running or record.id in self._opening:
            return
        self._opening.add(record.id)
        try:
            await self._open_sessions(record, fresh)
        except Unavailable as error:
            self.log.warn("pipe {name} can't be opened yet: {error}", name=record.name, error=str(error))
        except SwitchboardError as error:
            self._unopened.pop(record.id, None)
            await self._ended(record, str(error), moves=record.moves)
        finally:
            self._opening.discard(record.id)

    async def _open_sessions(self, record: PipeRecord, fresh: bool) -> None:
        """:raises SwitchboardError: the owner has no right on a robot; the database does not answer"""
        settings, address = settings_of(record), f"pipe {record.name}"
        admissions = []
        try:
            accounts = record.source_account_id, record.target_account_id
            for account, end in zip(accounts, _robot_ends(settings), strict=True):
                user = await self._database.read(queries.get_user, account)
                if user is None:
                    raise NotFound("the account of its owner was removed")
                principal = Principal.of_user(user)
                admissions.append(await self._sessions.admit(principal, _robot_name(end)[0], address))
            if self._leaving or record.id not in self._unopened:
                # It was stopped meanwhile.
                raise Unavailable("it is not wanted any more")
        except BaseException:
            for each in admissions:
                self._sessions.release(each)
            raise
        del self._unopened[record.id]
        source, target = PipePort(), PipePort()
        running = RunningPipe(
            self._clock,
            record,
            settings,
            source,
            target,
            programs=self._programs,
            clock_ns=self._clock_ns,
            fresh=fresh,
            on_end=self._on_end,
            on_reply=self._on_reply,
        )
        for port, admission in zip((source, target), admissions, strict=True):
            port.pipe = running
            port.on_close = partial(self._on_close, running, port)
            port.begin(self._sessions.open_in_process(admission, port))
        self._running[record.id] = running
        self._publish("pipe.started", running)
        running.begin()

    def _on_close(self, running: RunningPipe, port: PipePort) -> None:
        if isinstance(port.closed, Refused):
            running.end(str(port.closed))
        elif not running.ended:
            # Not by a rule: it is opened again.
            running.close()
            self._running.pop(running.record.id, None)
            self._unopened[running.record.id] = running.record

    def _on_end(self, running: RunningPipe, reason: str) -> None:
        self._running.pop(running.record.id, None)
        self._publish("pipe.ended", running)
        work = Deferred.fromCoroutine(self._ended(running.record, reason, moves=running.moves))
        work.addErrback(lambda failure: self.log.failure("the end of a pipe could not be stored", failure))

    def _on_value(self, value: PublishedValue) -> int:
        end = PipeEnd(program=value.program, port=value.port)
        body = message_of(value.value)
        return self._on_reply(PipeReply(value.user, end_key(end, 0, value.user), body, value.earliest_sent))

    def _on_reply(self, reply: PipeReply) -> int:
        carrying = [each for each in self._running.values() if each.carries_reply(reply)]
        for each in carrying:
            each.receive_reply(reply)
        return len(carrying)

    async def _ended(self, record: PipeRecord, reason: str, *, moves: bool) -> None:
        self.log.info("pipe {name} has ended: {reason}", name=record.name, reason=reason)
        with self._while_changing(record):
            await self._database.write(self._note_end, record, reason, moves)

    def _close(self, record: PipeRecord) -> None:
        self._unopened.pop(record.id, None)
        running = self._running.pop(record.id, None)
        if running is not None:
            running.close()
            self._publish("pipe.ended", running)

    def _publish(self, kind: str, running: RunningPipe) -> None:
        robot, record = running.target_robot, running.record
        name = robot.name_of(*split_name(record.owner))
        self._bus.publish(kind, robot.robot_id, f"user:{name}", pipe=record.name)

    def _on_event(self, event: BusEvent) -> None:
        if event.kind == "robot.stopped":
            for each in list(self._running.values()):
                if each.target_robot.robot_id == event.robot_id:
                    each.robot_stopped()

    def _check_all(self) -> None:
        for each in list(self._running.values()):
            each.check()

    def _ping_all(self) -> None:
        for each in list(self._running.values()):
            each.ping()

    def _open_all(self) -> None:
        if not isinstance(self._homes, SingleHome):
            reading = Deferred.fromCoroutine(self._follow_cluster())
            reading.addErrback(lambda failure: self.log.info("pipes can't be read: {e}", e=failure.value))
        for record in list(self._unopened.values()):
            work = Deferred.fromCoroutine(self._open(record, fresh=False))
            work.addErrback(lambda failure: self.log.failure("a pipe could not be opened", failure))

    async def _follow_cluster(self) -> None:
        """Run what other relays have started and this one is to run, and nothing that they have stopped.

        :raises Unavailable: the database does not answer
        """
        known: dict[int, PipeRecord | RunningPipe] = {**self._unopened, **self._running}
        changed = self._changed
        enabled = {each.id: each for each in await self._database.read(queries.list_pipes) if each.enabled}
        for number, pipe in known.items():
            if pipe is self._running.get(number, self._unopened.get(number)):
                record = pipe if isinstance(pipe, PipeRecord) else pipe.record
                if number not in enabled or self._homes.elsewhere(record.target_robot_id) is not None:
                    self._close(record)
        if changed != self._changed:
            # What the database said may be older than a change made here.
            return
        for record in enabled.values():
            new = not {record.id} & (self._running.keys() | self._unopened.keys() | self._changing.keys())
            if new and not self._leaving and self._homes.elsewhere(record.target_robot_id) is None:
                self._unopened[record.id] = record

    # --- answers ------------------------------------------------------------------------------------------

    def _status(self, record: PipeRecord) -> PipeStatus:
        running, settings = self._running.get(record.id), settings_of(record)
        state, why = self._state(record, running)
        return PipeStatus(
            name=record.name,
            owner=record.owner,
            source=settings.source,
            target=settings.target,
            fields=settings.fields,
            rate=settings.rate,
            state=state,
            why=why,
            moves=record.moves if running is None else running.moves,
            messages=0 if running is None else running.messages,
            drops=0 if running is None else running.drops,
            encoded=0 if running is None else running.encoded,
            latency_ms=None
            if running is None or running.latency is None
            else round(running.latency * 1000, 3),
        )

    def _state(self, record: PipeRecord, running: RunningPipe | None) -> tuple[PipeState, str]:
        if running is not None:
            return ("waiting", f"waiting for {running.why}") if running.why else ("running", running.problem)
        if record.id in self._unopened:
            return "waiting", "waiting for the relay to open it"
        if record.enabled and self._homes.elsewhere(record.target_robot_id) is not None:
            return "waiting", ELSEWHERE
        return ("refused", record.reason) if record.reason else ("stopped", "")


def settings_of(record: PipeRecord) -> PipeSettings:
    """The settings of a stored pipe."""
    return msgspec.json.decode(record.settings, type=PipeSettings)


def merge_pipes(own: PipeList, others: Iterable[PipeList]) -> PipeList:
    """A relay's list of pipes, with the states that other relays know of those that run there."""
    known = {each.name: each for other in others for each in other.pipes if each.why != ELSEWHERE}
    return PipeList([known.get(each.name, each) if each.why == ELSEWHERE else each for each in own.pipes])


def robot_of_target(settings: PipeSettings) -> str:
    """The name of the robot that a pipe's messages go to, as its owner writes it; of a program's pipe the only one."""
    return _robot_ends(settings)[1].robot


def _may_see(user: PipeUser, record: PipeRecord) -> bool:
    return user.realm in (None, record.realm) and (user.all or user.user_id == record.owner_id)


def _owner_of(s: Session, user: PipeUser, owner: str) -> int:
    """:raises NotFound: there is no such user"""
    if user.user_id is not None:
        return user.user_id
    found = queries.find_user(s, *split_name(owner))
    if found is None:
        raise NotFound(f"there is no user '{owner}'; name the owner of the pipe, by whose rights it runs")
    return found.id


def _ends_of(
    s: Session, user: PipeUser, new: NewPipe, owner: str
) -> tuple[int, list[UserRecord], list[RobotRecord]]:
    """The owner of a new pipe, and the account and robot of both ends.

    :raises NotFound: no such owner or robot, or no right on it
    """
    owner_id = _owner_of(s, user, owner)
    names, realms = zip(*map(_robot_name, _robot_ends(new)), strict=True)
    accounts = queries.pipe_accounts(s, owner_id, realms)
    robots = []
    for name, account in zip(names, accounts, strict=True):
        robot = queries.find_robot(s, name, account.realm)
        if robot is None or not queries.grants_for(s, account.id, robot.id):
            raise NotFound(f"there is no robot '{name}', or its owner has no right on it")
        robots.append(robot)
    return owner_id, accounts, robots


def _robot_name(end: PipeEnd) -> tuple[str, str | None]:
    """The name of a robot and the realm by which the owner reaches it; ``None`` for the owner's own."""
    name, at, realm = end.robot.partition("@")
    return name, realm if at else None


def _robot_ends(settings: PipeSettings) -> tuple[PipeEnd, PipeEnd]:
    """The ends at whose robots the sessions of source and target are; for a program that of the other end."""
    source, target = settings.source, settings.target
    return target if source.program else source, source if target.program else target


def _edge(record: PipeRecord, *, shown: bool = True) -> PipeEdge:
    """:param shown: whether errors may name the pipe"""
    settings = settings_of(record)
    return PipeEdge(
        record.name if shown else "a pipe of another user",
        end_key(settings.source, record.source_robot_id, record.owner_id),
        end_key(settings.target, record.target_robot_id, record.owner_id),
        settings.rate > 0,
    )


def _check_targets(targets: list[str]) -> None:
    """:raises Invalid: two mappings write the same field, or one writes into what the other has written"""
    for first, second in pairwise(sorted(targets, key=lambda each: each.split("."))):
        if second == first or second.startswith(f"{first}."):
            raise Invalid(f"two mappings write '{first}': '{first}' and '{second}'")


def _check_settings(new: NewPipe) -> None:
    """:raises Invalid: they can't be used, whatever the robots have"""
    for mapping in new.fields:
        steps_of(mapping.source)
    _check_targets([mapping.target for mapping in new.fields])
    for end in (new.source, new.target):
        if end.service:
            check_service(end.service)
    if new.source.program and new.target.program:
        raise Invalid("one end of a pipe is at a robot; programs send requests to each other by ICPI")
    if (new.source.service or new.source.action) and not new.fields and new.target.topic:
        raise Invalid("a reply is no message of a topic; carry fields of it")
    if new.source.action and new.rate:
        raise Invalid("an action can't be a source with a rate; results of goals by other pipes are carried")
    if not new.source.topic and new.rate > MAX_POLLS:
        what = "service" if new.source.service else "program"
        raise Invalid(f"a {what} can be called {MAX_POLLS:g} times a second at most, not {new.rate:g}")
