"""Roles that users start: their modules, devices and pipes, in this order, by the rights of that user."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import msgspec
from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred, DeferredLock
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import RoleRunRecord
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.realms import full_name
from relay_protocol.rights import Operation
from relay_server.access import Principal
from relay_server.cluster.relays import RelayInfo
from relay_server.common.clock import Clock, PeriodicTimer, PeriodicTimers
from relay_server.common.concurrency import shield
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.icpi.programs import ProgramRegistry
from relay_server.modules.robot_modules import ModuleRegistry
from relay_server.pipes.schemas import NewPipe, PipeStatus
from relay_server.pipes.service import PipeService, PipeUser, pipe_user
from relay_server.roles.bindings import ElementNotCommandable, binding_of
from relay_server.roles.commands import RoleCommands, RoleUser, Switch
from relay_server.roles.plan import RolePart, plan_of, unbound
from relay_server.roles.schemas import RoleInfo, RolePartState, RoleRunState, RunState
from relay_server.roles.service import RoleService
from relay_server.sessions.manager import Admission, SessionManager

WATCH_SECONDS = 2.0
"""Seconds between attempts to watch the rights of a Role that was started before the relay."""

TICK_SECONDS = 0.5
"""Seconds between notifications of clients that follow the state of Roles."""

ELSEWHERE = "elsewhere"
"""Stands for the state of a module until the other relay that its robot is connected to is asked."""

NOT_ALL_STOPPED = "some parts could not be stopped; stop the Role again"

_COMING = frozenset({"starting", "waiting", "pending", "stopping", "backing_off"})
_UP = frozenset({"running", "on"})


class StartedByAnother(Refused):
    """Another user has started the Role."""

    code = "started_by_another"
    http_status = 409


class _Watch(NamedTuple):
    """Permits of the user on the robots of a started Role; they follow changes of rights."""

    run: RoleRunRecord
    admissions: list[Admission]


class RoleRuns:
    """
    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        roles: RoleService,
        commands: RoleCommands,
        pipes: PipeService,
        modules: ModuleRegistry,
        programs: ProgramRegistry,
        sessions: SessionManager,
        database: AsyncDatabase,
        bus: EventBus,
        *,
        wall: Callable[[], float],
    ) -> None:
        self._roles = roles
        self._commands = commands
        self._pipes = pipes
        self._modules = modules
        self._programs = programs
        self._sessions = sessions
        self._database = database
        self._bus = bus
        self._wall = wall
        self._timers = PeriodicTimers(clock)
        self._watches: dict[int, _Watch] = {}
        self._unwatched: dict[int, RoleRunRecord] = {}
        self._incomplete = False
        """Whether Roles may be started that are in neither of these."""
        self._changing: WeakValueDictionary[tuple[str, str], DeferredLock] = WeakValueDictionary()
        self._followers: list[Callable[[], None]] = []
        self._timer_list = [
            PeriodicTimer(self._watch_all, WATCH_SECONDS),
            PeriodicTimer(self._tick, TICK_SECONDS),
        ]

    # --- the relay ----------------------------------------------------------------------------------------

    async def begin(self) -> None:
        """Go on with the Roles that were started before. Modules run on, and pipes go on by themselves."""
        for run in await self._database.read(queries.list_role_runs):
            if not run.reason:
                self._unwatched[run.role_id] = run
        for timer in self._timer_list:
            self._timers.start(timer)

    def leave(self, reason: str) -> None:
        """The relay shuts down; Roles stay started."""
        for timer in self._timer_list:
            timer.stop()
        for role_id in list(self._watches):
            self._unwatch(role_id)

    # --- users --------------------------------------------------------------------------------------------

    async def start(self, user: RoleUser, role: str) -> RoleRunState:
        """Start a Role, or what is not up of one that the user has started. A part that fails stops no other.

        :raises NotFound: there is none that the user may see
        :raises StartedByAnother: another user has started it
        :raises Invalid: there is nothing to start
        """
        principal = user.principal
        principal.require_full_scope()
        self._roles.count_change(principal)
        elements = await self._roles.elements(principal, role)
        missing = await self._roles.missing(principal, role)
        if missing:
            raise Invalid(f"the Role {role} can't be started: {'; '.join(missing)}")
        others = await self._roles.resources_elsewhere(principal, role, unbound(elements))

        async def work() -> RoleRunState:
            async with self._lock(principal.realm, role):
                started = await self._start(user, role, lambda number: plan_of(number, elements, others))
            await self._join(principal.realm, role, principal.user_id)
            return started

        # To its end, also when the client has left.
        return await shield(Deferred.fromCoroutine(work()))

    async def _start(self, user: RoleUser, role: str, plan: Callable[[int], list[RolePart]]) -> RoleRunState:
        principal = user.principal
        up = await self._up(principal, role)
        role_id, parts, before = await self._database.write(self._begin, user, role, plan)
        # Until the end of this, and if the database fails meanwhile, the Role is watched by what is stored.
        self._unwatch(role_id)
        self._incomplete = True
        if before is not None:
            parts += await self._stop_others(before, user, parts)
        started = await self._started(principal.realm)
        for part in parts:
            part.waits = bool(part.waits_for(started))
            if not part.error and not part.waits and (part.resource, part.new) not in up:
                part.error = await self._carry_out(user, role, part, start=True)
        await self._database.write(queries.set_role_parts, role_id, _encoded(parts))
        run = await self._find(principal.realm, role)
        if run is not None:
            self._unwatched[role_id] = run
            await self._watch(run, locked=True)
            self._publish("role.started", run, self._admissions(role_id))
        return await self.state(principal, role)

    async def _up(self, principal: Principal, role: str) -> set[tuple[str, str]]:
        """What a started Role of the user has running already, and need not be started again.

        Programs are asked again: one that has connected again since does not know that it was started.
        """
        run = await self._find(principal.realm, role)
        if run is None or run.reason or run.user.id != principal.user_id:
            return set()
        states = await self._part_states(run)
        return {
            (part.resource, part.new)
            for part, now in zip(_decoded(run), states, strict=True)
            if not part.error
            and not part.waits
            and part.binding.kind != "programs"
            and now.state in _UP | _COMING
        }

    async def _stop_others(
        self, before: RoleRunRecord, user: RoleUser, parts: list[RolePart]
    ) -> list[RolePart]:
        """Stop what a Role ran before and has no more, as its document was replaced; what could not be stopped."""
        owner = RoleUser(Principal.of_user(before.user), user.address, user.earliest_sent)
        old = _others(before, parts)
        for part in old:
            part.error = await self._carry_out(owner, before.role, part, start=False)
        return [each for each in old if each.still_runs]

    async def stop(self, user: RoleUser, role: str) -> RoleRunState:
        """Stop a Role: its pipes first, its modules last. Parts that could not be stopped can be stopped again.

        :raises NotFound: there is none that the user may see
        :raises Refused: another user has started it, and the user may not change it
        """
        principal = user.principal
        principal.require_full_scope()
        info = await self._roles.role(principal, role)

        async def work() -> RoleRunState:
            async with self._lock(principal.realm, role):
                stopped = await self._stop(user, role, info)
            await self._join(principal.realm, role, principal.user_id)
            return stopped

        return await shield(Deferred.fromCoroutine(work()))

    async def _stop(self, user: RoleUser, role: str, info: RoleInfo) -> RoleRunState:
        principal = user.principal
        run = await self._find(principal.realm, role)
        if run is None:
            return RoleRunState(role, "stopped")
        if run.user.id != principal.user_id and not info.yours:
            raise Refused(f"{run.user.name} has started the Role {role}; only they and its owner may stop it")
        admissions = self._unwatch(run.role_id)
        parts = _decoded(run)
        owner = RoleUser(Principal.of_user(run.user), user.address, user.earliest_sent)
        for part in reversed(parts):
            part.error = await self._carry_out(owner, role, part, start=False)
        await self._database.write(self._note_stop, user, run, [each for each in parts if each.still_runs])
        self._publish("role.stopped", run, admissions)
        if any(each.still_runs for each in parts):
            return await self.state(principal, role)
        return RoleRunState(role, "stopped", parts=_failed(parts))

    async def _started(self, realm: str) -> frozenset[str]:
        """Names of the Roles that are started."""
        runs = await self._database.read(queries.list_role_runs, realm)
        return frozenset(each.role for each in runs if not each.reason)

    async def _join(self, realm: str, changed: str, by: int) -> None:
        """Start or stop the pipes between other Roles and one that was started or stopped.

        :param by: number of the user; a pipe of another user does not begin to move a robot by this
        """
        for run in await self._database.read(queries.list_role_runs, realm):
            if any(changed in roles for part in _decoded(run) for roles in part.needs):
                async with self._lock(realm, run.role):
                    await self._join_one(realm, run.role, changed, by)

    async def _join_one(self, realm: str, role: str, changed: str, by: int) -> None:
        run = await self._find(realm, role)
        if run is None or run.reason:
            return
        started, parts = await self._started(realm), _decoded(run)
        owner = RoleUser(Principal.of_user(run.user), "")
        for part in parts:
            waits = bool(part.waits_for(started))
            if any(changed in each for each in part.needs) and waits != part.waits:
                part.waits = waits
                fresh = run.user.id == by
                part.error = await self._carry_out(owner, role, part, start=not waits, fresh=fresh)
        await self._database.write(queries.set_role_parts, run.role_id, _encoded(parts))

    async def state(self, principal: Principal, role: str) -> RoleRunState:
        """The state of a Role now. Its parts are for the user who started it, and for those who may change the Role.

        :raises NotFound: there is none that the user may see
        """
        info = await self._roles.role(principal, role)
        run = await self._find(principal.realm, role)
        if run is None:
            return RoleRunState(role, "stopped")
        parts = _failed(_decoded(run)) if run.reason else await self._part_states(run)
        return RoleRunState(
            role,
            "ended" if run.reason else _state_of(parts),
            why=run.reason,
            by=run.user.name,
            at=run.at,
            parts=parts if info.yours or run.user.id == principal.user_id else [],
        )

    def _lock(self, realm: str, role: str) -> DeferredLock:
        return self._changing.setdefault((realm, role), DeferredLock())

    def on_tick(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call ``listener`` whenever the state of Roles may have changed; returns a function that ends this."""
        self._followers.append(listener)
        return partial(self._followers.remove, listener)

    async def relay_of(
        self, principal: Principal, role: str, relay_of_robot: Callable[[str], Awaitable[RelayInfo | None]]
    ) -> RelayInfo | None:
        """The other relay of the cluster that all robots of a Role are connected to.

        :param relay_of_robot: of a robot's name
        :returns: ``None``: there is none; parts at other relays than this fail
        :raises NotFound: there is no such Role that the user may see
        """
        elements = await self._roles.elements(principal, role)
        others = await self._roles.resources_elsewhere(principal, role, unbound(elements))
        resources = [resource for each in elements for resource in each.resources]
        resources += [each for roles in others.values() for found in roles.values() for each in found]
        bindings = map(binding_of, resources)
        own = f"@{principal.realm}"
        robots = {each.robot.removesuffix(own) for each in bindings if each is not None and each.robot}
        relays = [await relay_of_robot(each) for each in sorted(robots)]
        return relays[0] if relays and all(each == relays[0] for each in relays) else None

    # --- parts --------------------------------------------------------------------------------------------

    async def _carry_out(
        self, user: RoleUser, role: str, part: RolePart, *, start: bool, fresh: bool = True
    ) -> str:
        """Start or stop a part; why that failed, or empty."""
        may_run = not start and (part.still_runs or not part.error)
        part.still_runs = False
        try:
            if not part.mapped:
                command: Switch = "start" if start else "stop"
                await self._commands.switch_part(user, role, part.element, part.binding, command)
                return ""
            pipes, name = pipe_user(user.principal, user.address), part.binding.name
            await self._remove_pipe(pipes, name)
            if start:
                new = msgspec.json.decode(part.new, type=NewPipe)
                added = await self._pipes.add(pipes, new, counted=False, fresh=fresh)
                return added.why if added.state == "refused" else ""
        except SwitchboardError as error:
            part.still_runs = may_run and not isinstance(error, NotFound | ElementNotCommandable)
            return str(error)
        return ""

    async def _remove_pipe(self, user: PipeUser, name: str) -> None:
        try:
            await self._pipes.remove(user, name)
        except NotFound:
            return

    async def _part_states(self, run: RoleRunRecord) -> list[RolePartState]:
        owner = Principal.of_user(run.user)
        pipes = {each.name: each for each in (await self._pipes.pipes(pipe_user(owner, ""))).pipes}
        robots = {each.robot.full: each for each in self._admissions(run.role_id)}
        started = await self._started(run.realm)
        states = []
        for part in _decoded(run):
            if part.waits and not part.error:
                why = f"waiting for {part.waits_for(started) or 'its Roles'} to be started"
                states.append(RolePartState(part.element, part.resource, "waiting", why))
                continue
            state, why = self._part_state(part, run, pipes, robots)
            if state == ELSEWHERE:
                state, why = await self._module_elsewhere(owner, run, part)
            states.append(RolePartState(part.element, part.resource, state, why))
        return states

    def _part_state(
        self,
        part: RolePart,
        run: RoleRunRecord,
        pipes: dict[str, PipeStatus],
        robots: dict[str, Admission],
    ) -> tuple[str, str]:
        binding = part.binding
        if part.error:
            return "failed", part.error
        if binding.kind == "pipes":
            pipe = pipes.get(binding.name)
            return ("failed", "the pipe was removed") if pipe is None else (pipe.state, pipe.why)
        if binding.kind == "programs":
            known = any(each.name == binding.name for each in self._programs.of(run.user.id))
            return ("on", "") if known else ("waiting", f"waiting for program {binding.name} to connect")
        admission = robots.get(_full(binding.robot, run.realm))
        if admission is None:
            return "waiting", "waiting for the relay to check the rights"
        if admission.robot.elsewhere:
            return (ELSEWHERE if binding.kind == "modules" else "on"), ""
        if admission.robot.control_link is None:
            return "waiting", f"waiting for robot {binding.robot}, which is offline"
        if binding.kind != "modules":
            return "on", ""
        for module in self._modules.of(admission.robot).modules:
            if module.name == binding.name:
                return module.state, module.last_exit if module.state in ("failed", "backing_off") else ""
        return "failed", f"robot {binding.robot} has no module {binding.name}"

    async def _module_elsewhere(
        self, owner: Principal, run: RoleRunRecord, part: RolePart
    ) -> tuple[str, str]:
        """The state of a module whose robot is at another relay of the cluster."""
        try:
            found = (await self._commands.get(RoleUser(owner, ""), run.role, part.element)).value
        except SwitchboardError as error:
            return "waiting", str(error)
        state = str(found.get("state", ""))
        return state, str(found.get("last_exit", "")) if state in ("failed", "backing_off") else ""

    # --- rights -------------------------------------------------------------------------------------------

    def _admissions(self, role_id: int) -> list[Admission]:
        watch = self._watches.get(role_id)
        return [] if watch is None else watch.admissions

    async def _watch(self, run: RoleRunRecord, *, locked: bool = False) -> None:
        """Hold permits of the user on all robots of the Role, so that it ends when one is revoked.

        :param locked: whether the caller keeps others from changing the Role
        """
        admissions: list[Admission] = []
        try:
            for robot in dict.fromkeys(
                robot for each in _decoded(run) if not each.error for robot in each.robots
            ):
                admissions.append(await self._admit(run, robot))
        except SwitchboardError as error:
            for each in admissions:
                self._sessions.release(each)
            if not isinstance(error, Unavailable):
                await (self._end_alone if locked else self._end)(run, str(error))
            return
        if self._unwatched.pop(run.role_id, None) is None:
            for each in admissions:
                self._sessions.release(each)
            return
        self._watches[run.role_id] = _Watch(run, admissions)
        for each in admissions:
            each.permit.on_revoke = partial(self._revoked, run)
            each.permit.on_change = partial(self._check, run)
        self._check(run)

    async def _admit(self, run: RoleRunRecord, robot: str) -> Admission:
        """A permit of the user on a robot, for one in another realm by their account there.

        :raises SwitchboardError: there is no right, or no account; the database does not answer
        """
        user = run.user
        name, at, realm = robot.partition("@")
        if at and realm != run.realm:
            accounts = await self._database.read(queries.pipe_accounts, user.id, (realm, realm))
            user = accounts[0]
        return await self._sessions.admit(Principal.of_user(user), name, f"role {run.role}")

    def _check(self, run: RoleRunRecord) -> None:
        """End the Role if its user may no longer manage one of its modules."""
        permits = {each.robot.full: each.permit for each in self._admissions(run.role_id)}
        for part in _decoded(run):
            binding = part.binding
            robot = _full(binding.robot, run.realm)
            if binding.kind == "modules" and not part.error and robot in permits:
                decision = permits[robot].decide(Operation.MANAGE, binding.name)
                if not decision.allowed:
                    self._revoked(run, Refused(decision.reason))
                    return

    def _revoked(self, run: RoleRunRecord, error: Refused) -> None:
        work = Deferred.fromCoroutine(self._end(run, str(error)))
        work.addErrback(lambda failure: self.log.failure("the end of a Role could not be stored", failure))

    async def _end(self, run: RoleRunRecord, reason: str) -> None:
        """End a Role whose user lost a right, unless it was stopped or started again meanwhile."""
        async with self._lock(run.realm, run.role):
            now = await self._find(run.realm, run.role)
            if now is None or now.reason or (now.at, now.user.id) != (run.at, run.user.id):
                return
            await self._end_alone(now, reason)
        await self._join(run.realm, run.role, run.user.id)

    async def _end_alone(self, run: RoleRunRecord, reason: str) -> None:
        """Its pipes end; modules are left, as the right to stop them is gone."""
        admissions = self._unwatch(run.role_id)
        self.log.info("Role {name} has ended: {reason}", name=run.role, reason=reason)
        owner = RoleUser(Principal.of_user(run.user), "")
        for part in reversed(_decoded(run)):
            if part.binding.kind == "pipes":
                await self._carry_out(owner, run.role, part, start=False)
        if await self._database.write(self._note_end, run, reason):
            self._publish("role.ended", run, admissions)

    def _unwatch(self, role_id: int) -> list[Admission]:
        admissions = self._admissions(role_id)
        self._unwatched.pop(role_id, None)
        self._watches.pop(role_id, None)
        for each in admissions:
            each.permit.on_revoke = each.permit.on_change = _ignore
            self._sessions.release(each)
        return admissions

    def _watch_all(self) -> None:
        work = Deferred.fromCoroutine(self._watch_unwatched())
        work.addErrback(self._not_watched)

    async def _watch_unwatched(self) -> None:
        if self._incomplete:
            self._incomplete = False
            try:
                runs = await self._database.read(queries.list_role_runs)
            except BaseException:
                self._incomplete = True
                raise
            for run in runs:
                if not run.reason and run.role_id not in self._watches and not self._is_changing(run):
                    self._unwatched.setdefault(run.role_id, run)
        for run in list(self._unwatched.values()):
            if not self._is_changing(run):
                await self._watch(run)

    def _is_changing(self, run: RoleRunRecord) -> bool:
        """Whether a start or stop is under way. It has the Role watched itself."""
        lock = self._changing.get((run.realm, run.role))
        if lock is None or not lock.locked:
            return False
        self._incomplete = True
        return True

    def _not_watched(self, failure: Any) -> None:
        if not failure.check(Unavailable):
            self.log.failure("a Role could not be watched", failure)

    def _tick(self) -> None:
        for listener in list(self._followers):
            listener()

    # --- the database -------------------------------------------------------------------------------------

    async def _find(self, realm: str, role: str) -> RoleRunRecord | None:
        found = await self._database.read(queries.list_role_runs, realm, role)
        return found[0] if found else None

    def _begin(
        self, s: Session, user: RoleUser, role: str, plan: Callable[[int], list[RolePart]]
    ) -> tuple[int, list[RolePart], RoleRunRecord | None]:
        principal, before = user.principal, None
        for run in queries.list_role_runs(s, principal.realm, role):
            before = run
            if run.user.id != principal.user_id and not run.reason:
                raise StartedByAnother(
                    f"{run.user.name} has started the Role {role}; it must be stopped first"
                )
        role_id = queries.begin_role_run(s, principal.realm, role, principal.user_id, self._wall())
        if role_id is None:
            raise NotFound(f"there is no Role {role}")
        parts = plan(role_id)
        if not parts:
            raise Invalid(
                f"the Role {role} has nothing to start: no element is bound to a module or pipe, and no mapping "
                "connects topics or fields of services"
            )
        # What runs on from before is stored until it is stopped.
        others = [] if before is None else _others(before, parts)
        queries.set_role_parts(s, role_id, _encoded([*parts, *others]))
        self._audit(s, f"user:{principal.full}", "role.start", role, principal.realm, user.address)
        return role_id, parts, before

    def _note_stop(self, s: Session, user: RoleUser, run: RoleRunRecord, left: list[RolePart]) -> None:
        if left:
            queries.set_role_parts(s, run.role_id, _encoded(left))
            queries.end_role_run(s, run.role_id, NOT_ALL_STOPPED)
        else:
            queries.remove_role_run(s, run.role_id)
        self._audit(s, f"user:{user.principal.full}", "role.stop", run.role, run.realm, user.address)

    def _note_end(self, s: Session, run: RoleRunRecord, reason: str) -> bool:
        ended = queries.end_role_run(s, run.role_id, reason)
        if ended:
            self._audit(s, "relay", "role.end", run.role, run.realm, "", why=reason)
        return ended

    def _audit(
        self, s: Session, actor: str, action: str, role: str, realm: str, origin: str, **data: str
    ) -> None:
        queries.append_audit(
            s,
            at=self._wall(),
            actor=actor,
            action=action,
            target=f"{role}@{realm}",
            origin=origin,
            data=dict(data),
        )

    def _publish(self, kind: str, run: RoleRunRecord, admissions: list[Admission]) -> None:
        for each in admissions:
            source = f"user:{each.robot.name_of(run.user.name, run.realm)}"
            self._bus.publish(kind, each.robot.robot_id, source, role=run.role)


def _full(robot: str, realm: str) -> str:
    """The full name of a robot by the name that users of a realm have for it."""
    name, at, other = robot.partition("@")
    return full_name(name, other if at else realm)


def _ignore(*_: object) -> None:
    pass


def _others(before: RoleRunRecord, parts: list[RolePart]) -> list[RolePart]:
    """What a Role ran before and has no more, in the order of stopping."""
    kept = {each.resource for each in parts}
    return [each for each in reversed(_decoded(before)) if each.resource not in kept]


def _state_of(parts: list[RolePartState]) -> RunState:
    states = {each.state for each in parts}
    if states <= _UP:
        return "running"
    return "starting" if states <= _UP | _COMING else "partial"


def _failed(parts: list[RolePart]) -> list[RolePartState]:
    return [RolePartState(each.element, each.resource, "failed", each.error) for each in parts if each.error]


def _encoded(parts: list[RolePart]) -> str:
    return msgspec.json.encode(parts).decode()


def _decoded(run: RoleRunRecord) -> list[RolePart]:
    return msgspec.json.decode(run.parts, type=list[RolePart])
