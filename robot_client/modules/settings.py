"""Settings of modules: the ``[[module]]`` tables of the robot's settings file. Only these modules can be run."""

from __future__ import annotations

import re
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Annotated, Any, Literal

import msgspec

from relay_protocol import limits
from relay_protocol.link import MODULE_NAME
from robot_client.modules.processes import KILL_SECONDS, TERM_SECONDS

PYTHON_READY = r"^READY$"
"""A module of kind ``python`` prints this when it has started, see :mod:`robot_client.devices.host`."""

RESERVED_NAMES = frozenset({"daemon", "guard", "camera", "middleware", "processes"})
"""Names of the robot's other processes and resources, in tables, alerts, rights and URLs. No module has one."""

ROS_VARIABLES = {"domain": ("ROS_DOMAIN_ID", "0"), "rmw": ("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")}
"""Environment variables of ROS 2 by the setting that sets them, each with its value where none is set."""

_CLASS = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*\Z")
_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")

Seconds = Annotated[float, msgspec.Meta(gt=0, le=3600)]


KINDS = ("command", "python", "launch")


class ModuleSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One module. It has one of ``command``, ``python`` and ``launch``.

    :param name: lower case, with digits, ``-`` and ``_``
    :param command: program and arguments, without a shell
    :param python: module and class, a :class:`robot_client.devices.Module`: ``my_robot.lidar:Lidar``
    :param settings: arguments of that class
    :param launch: package, launch file and arguments of ``ros2 launch``
    :param autostart: whether it starts with the daemon
    :param restart: when it is started again after it has ended
    :param restarts: most restarts within ``within_s``; with one more it has failed
    :param within_s: time in which restarts are counted
    :param backoff_s: pause before the first restart; it doubles with each one, up to a minute
    :param after: modules that must be ready before it starts
    :param ready_log: regular expression; the module is ready once a line of its output matches
    :param ready_topic: the module is ready once this topic has a publisher that it had not when the module was started
    :param ready_service: the module is ready once this service has a server that it had not when the module was started
    :param ready_lifecycle: the module is ready once this lifecycle node is active
    :param ready_within_s: a module that is not ready by then is stopped, and counts as crashed
    :param environment: variables beside those of the daemon
    :param folder: working directory; empty for the daemon's
    :param domain: ROS domain, where it is not the daemon's
    :param rmw: ROS middleware, where it is not the daemon's
    :param cpus: CPU numbers it may use; empty for all
    :param nice: added to the daemon's niceness
    :param memory_mb: most address space of each of its processes; 0 for no limit
    :param term_after_s: time between SIGINT and SIGTERM when it is stopped
    :param kill_after_s: time between SIGTERM and SIGKILL
    :param log_mb: size of its log on disk
    """

    name: str
    command: list[str] = msgspec.field(default_factory=list)
    python: str = ""
    settings: dict[str, Any] = msgspec.field(default_factory=dict)
    launch: list[str] = msgspec.field(default_factory=list)
    autostart: bool = True
    restart: Literal["on-failure", "always", "never"] = "on-failure"
    restarts: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 5
    within_s: Seconds = 300.0
    backoff_s: Seconds = 1.0
    after: list[str] = msgspec.field(default_factory=list)
    ready_log: str = ""
    ready_topic: str = ""
    ready_service: str = ""
    ready_lifecycle: str = ""
    ready_within_s: Seconds = 30.0
    environment: dict[str, str] = msgspec.field(default_factory=dict)
    folder: str = ""
    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] | None = None
    rmw: str = ""
    cpus: list[Annotated[int, msgspec.Meta(ge=0)]] = msgspec.field(default_factory=list)
    nice: Annotated[int, msgspec.Meta(ge=0, le=19)] = 0
    memory_mb: Annotated[int, msgspec.Meta(ge=0)] = 0
    term_after_s: Seconds = TERM_SECONDS
    kill_after_s: Seconds = KILL_SECONDS
    log_mb: Annotated[float, msgspec.Meta(ge=0.1, le=10_000)] = 10.0

    @property
    def kind(self) -> str:
        """``command``, ``python`` or ``launch``."""
        return next(kind for kind in KINDS if getattr(self, kind))

    @property
    def own_environment(self) -> dict[str, str]:
        """Variables that differ from those of the daemon, with ``domain`` and ``rmw``."""
        own = dict(self.environment)
        if self.domain is not None:
            own["ROS_DOMAIN_ID"] = str(self.domain)
        if self.rmw:
            own["RMW_IMPLEMENTATION"] = self.rmw
        return own

    @property
    def ready_pattern(self) -> str:
        """Regular expression of the line of its output that says that it is ready; empty if none does."""
        return self.ready_log or (PYTHON_READY if self.python and not self.ready_names else "")

    @property
    def ready_names(self) -> dict[str, str]:
        """What in the ROS graph says that it is ready: at most one name, by its setting."""
        settings = ("ready_topic", "ready_service", "ready_lifecycle")
        return {each: getattr(self, each) for each in settings if getattr(self, each)}

    def __post_init__(self) -> None:
        if not re.match(MODULE_NAME, self.name):
            raise ValueError(
                f"module: '{self.name}' is not a name; write lower-case letters, digits, '-' and '_'"
            )
        if self.name in RESERVED_NAMES:
            raise ValueError(
                f"module: '{self.name}' is reserved for a part of the robot itself; choose another name, "
                f"which is none of {', '.join(sorted(RESERVED_NAMES))}"
            )
        if len([kind for kind in KINDS if getattr(self, kind)]) != 1:
            raise ValueError(f"module {self.name}: give one of command, python and launch")
        if self.python and not _CLASS.match(self.python):
            raise ValueError(
                f"module {self.name}: python = '{self.python}' is not a class; write 'package.module:Class'"
            )
        if self.settings and not self.python:
            raise ValueError(f"module {self.name}: settings are only for modules with python")
        if len(self.launch) == 1:
            raise ValueError(f"module {self.name}: launch needs a package and a launch file")
        self._check_readiness()
        try:
            re.compile(self.ready_log)
        except re.error as error:
            raise ValueError(f"module {self.name}: ready_log is not a regular expression: {error}") from None
        for variable in self.environment:
            if not _VARIABLE.match(variable):
                raise ValueError(f"module {self.name}: '{variable}' is not the name of a variable")

    def _check_readiness(self) -> None:
        given = [*["ready_log"] * bool(self.ready_log), *self.ready_names]
        if len(given) > 1:
            raise ValueError(f"module {self.name}: {' and '.join(given)} are given; give one of them")
        for setting, value in self.ready_names.items():
            if not value.startswith("/"):
                raise ValueError(
                    f"module {self.name}: {setting} = '{value}' is not absolute; write '/{value}'"
                )


def check_modules(modules: list[ModuleSettings]) -> None:
    """Check the dependencies of modules.

    :raises ValueError: a name is used twice, a dependency is missing, or modules depend on each other
    """
    names = [each.name for each in modules]
    if len(names) > limits.MODULES:
        raise ValueError(f"there are {len(names)} modules; a robot has at most {limits.MODULES}")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"module {name} is named twice")
    after = {each.name: each.after for each in modules}
    for name, others in after.items():
        for other in others:
            if other not in after:
                raise ValueError(f"module {name} comes after '{other}', which is missing")
    try:
        TopologicalSorter(after).prepare()
    except CycleError as error:
        raise ValueError(f"modules wait for each other: {' → '.join(error.args[1])}") from None


def check_readiness(modules: list[ModuleSettings], environment: Mapping[str, str]) -> None:
    """Check that the daemon can see what makes each module ready: its node is in one ROS graph only.

    :param environment: the daemon's
    :raises ValueError: a module with ``ready_topic``, ``ready_service`` or ``ready_lifecycle`` has a ROS domain or
        middleware of its own
    """
    for each in modules:
        own = {**environment, **each.own_environment}
        for setting, (variable, default) in ROS_VARIABLES.items():
            of_daemon, of_module = (values.get(variable) or default for values in (environment, own))
            if each.ready_names and of_module != of_daemon:
                (ready,) = each.ready_names
                raise ValueError(
                    f"module {each.name}: {ready} needs the {setting} of the daemon, {of_daemon}, which looks for it; "
                    f"the module has {setting} {of_module}. Use ready_log, or the same {setting} for both"
                )
