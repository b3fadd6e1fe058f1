"""Decides where a function runs, and records each decision."""

from __future__ import annotations

import functools
import inspect
import time
from collections import deque
from collections.abc import Callable
from types import MethodType
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar

from relay_protocol.errors import SwitchboardError, Unavailable
from relay_protocol.functions import spec_of
from robot_client.offload.cloud import CALL_SECONDS, Cloud, cloud
from robot_client.offload.device import WIRELESS, Device, Where, device
from robot_client.offload.function_link import Overtaken

P = ParamSpec("P")
R = TypeVar("R")

LOADED = ("cpu", "memory", "battery", "temperature")
"""Components that are relieved when a function runs elsewhere."""

KEPT = 1000
"""Most decisions that are remembered."""


class Decision(NamedTuple):
    """Where a call ran.

    :param at: Unix seconds
    :param where: ``here`` or ``cloud``
    :param why: in words
    :param seconds: of the whole call
    :param error: in words; empty if there was a result
    """

    at: float
    function: str
    where: str
    why: str
    seconds: float
    error: str


_decisions: deque[Decision] = deque(maxlen=KEPT)


def decisions() -> list[Decision]:
    """The latest decisions of this program, the oldest first."""
    return list(_decisions)


class Offloaded(Generic[P, R]):
    """A function that runs here or in the cloud. Called as the function itself.

    :param arguments: makes the arguments of the call in the cloud; by default they are those of the call here
    :param result: makes the result of its value in the cloud; by default that is the result
    :param repeatable: whether it may run here after a lost answer; by default as it is declared
    :param pause: after a call in the cloud without a result it runs here for so many seconds, if it may
    :ivar where: ``auto`` decides by the robot's settings and the state of the device; ``here`` and ``cloud`` force the
        place
    :ivar latest: the latest decision
    """

    def __init__(
        self,
        local: Callable[P, R],
        name: str,
        *,
        when: Callable[[Device], bool] | None = None,
        fallback: bool = True,
        timeout: float = CALL_SECONDS,
        newest: bool | str = False,
        version: int | None = None,
        client: Cloud = cloud,
        state: Device = device,
        arguments: Callable[P, dict[str, Any]] | None = None,
        result: Callable[[Any], R] | None = None,
        repeatable: bool | None = None,
        pause: float = 0.0,
    ) -> None:
        functools.update_wrapper(self, local)
        self.where: Where = "auto"
        self._local = local
        self._name = name
        self._when = when
        self._fallback = fallback
        self._options: dict[str, Any] = {"timeout": timeout, "newest": newest, "version": version}
        self._cloud = client
        self._device = state
        self._arguments = arguments or self._same_arguments
        self._result = result
        spec = spec_of(local)
        self._repeatable = (spec is not None and spec.repeatable) if repeatable is None else repeatable
        self._pause = pause
        self._here_until = -pause
        self.latest: Decision | None = None

    def __get__(self, instance: object, owner: type | None = None) -> Any:
        """As of a function: a decorated method has its object as first argument, which is not sent."""
        return self if instance is None else MethodType(self, instance)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        where, why = self._decide()
        began = time.monotonic()
        if where == "cloud":
            try:
                arguments = self._arguments(*args, **kwargs)
                found = self._cloud.call(self._name, **self._options, **arguments)
                value: R = found if self._result is None else self._result(found)
            except SwitchboardError as error:
                self._record("cloud", why, began, str(error))
                self._here_until = time.monotonic() + self._pause
                if not self._may_fall_back(error):
                    raise
                why = f"the cloud did not do it: {error}"
            else:
                self._record("cloud", why, began)
                return value
        began = time.monotonic()
        try:
            value = self._local(*args, **kwargs)
        except Exception as error:
            self._record("here", why, began, f"{type(error).__name__}: {error}")
            raise
        self._record("here", why, began)
        return value

    @property
    def ran_away(self) -> bool:
        """Whether the latest call ran in the cloud."""
        return self.latest is not None and self.latest.where == "cloud"

    def shown(self) -> dict[str, str]:
        """The latest decision, for display."""
        return {} if self.latest is None else {"runs": self.latest.where, "because": self.latest.why}

    def _same_arguments(self, *args: P.args, **kwargs: P.kwargs) -> dict[str, Any]:
        arguments = inspect.signature(self._local).bind(*args, **kwargs).arguments
        arguments.pop("self", None)
        return arguments

    def _decide(self) -> tuple[str, str]:
        if self.where != "auto":
            return self.where, "forced"
        if self._fallback and time.monotonic() < self._here_until:
            return "here", "the cloud gave no result recently"
        if self._when is not None:
            away = self._when(self._device)
            return ("cloud" if away else "here"), "as 'when' says"
        wanted = self._device.where()
        if wanted != "auto":
            return wanted, "as the robot's settings say"
        if any(map(self._device.critical, WIRELESS)):
            return "here", "the signal is too weak"
        critical = [each for each in LOADED if self._device.critical(each)]
        if critical:
            return "cloud", f"{', '.join(critical)} critical"
        return "here", "nothing is critical"

    def _may_fall_back(self, error: SwitchboardError) -> bool:
        """Whether the function may run here now: it did not run there, or may run twice."""
        unsent = isinstance(error, Unavailable)
        if isinstance(error, Overtaken):
            return False
        return self._fallback and self.where != "cloud" and (unsent or self._repeatable)

    def _record(self, where: str, why: str, began: float, error: str = "") -> None:
        self.latest = Decision(time.time(), self._name, where, why, time.monotonic() - began, error)
        _decisions.append(self.latest)


def offload(
    name: str = "",
    *,
    when: Callable[[Device], bool] | None = None,
    fallback: bool = True,
    timeout: float = CALL_SECONDS,
    newest: bool | str = False,
    version: int | None = None,
    client: Cloud = cloud,
    state: Device = device,
) -> Callable[[Callable[P, R]], Offloaded[P, R]]:
    """Decorator: the function runs here or in the cloud, with the same call.

    :param name: of the function on the workers; without it, that of its declaration or its own
    :param when: decides by the device: true for the cloud. By default a critical processor, memory, battery or
        temperature does, unless the signal is critical too
    :param fallback: whether it runs here when the relay can't be reached; also after a lost answer, if it is
        declared repeatable
    :param timeout: seconds for a call in the cloud
    :param newest: of calls that wait for an earlier one in the cloud only the newest is sent; see :meth:`Cloud.call`
    """

    def wrap(local: Callable[P, R]) -> Offloaded[P, R]:
        spec = spec_of(local)
        return Offloaded(
            local,
            name or (spec.name if spec is not None else getattr(local, "__name__", "function")),
            when=when,
            fallback=fallback,
            timeout=timeout,
            newest=newest,
            version=version,
            client=client,
            state=state,
        )

    return wrap
