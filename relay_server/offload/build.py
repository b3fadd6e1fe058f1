"""Builds the functions of a relay from its settings."""

from __future__ import annotations

import time
from typing import Any

from relay_protocol.errors import Invalid
from relay_server.config import OffloadSettings
from relay_server.core import Core
from relay_server.offload.engine import Engine
from relay_server.offload.pebble_engine import PebbleEngine
from relay_server.offload.robot_link import FunctionLinks
from relay_server.offload.service import FunctionService


def build_functions(core: Core) -> FunctionService:
    """The functions of a relay; no process is started yet.

    :raises Invalid: a setting can't be used, or the extra ``dask`` is not installed
    """
    engine = build_engine(core.reactor, core.settings.offload)
    return FunctionService(core.reactor, engine, core.access, core.database, time.time, relay=core.relay_id)


def build_engine(reactor: Any, settings: OffloadSettings) -> Engine:
    """Processes on this machine, or the workers of a Dask scheduler.

    :raises Invalid: a setting can't be used, or the extra ``dask`` is not installed
    """
    if not settings.scheduler:
        return PebbleEngine(reactor, settings.processes, settings.folder)
    try:
        from relay_server.offload.dask_engine import DaskEngine
        from relay_server.offload.dask_worker import security_of
    except ImportError as error:
        raise Invalid(f"--offload-scheduler needs the extra 'dask' ({error})") from None
    return DaskEngine(reactor, settings.scheduler, security_of(settings.scheduler, settings.tls))


def build_function_links(core: Core, functions: FunctionService) -> FunctionLinks:
    """The links by which robots call them."""
    return FunctionLinks(core.reactor, functions, core.database, core.settings.offload.robots)
