"""Runs one module: ``python -m robot_client.devices.host PACKAGE.MODULE:CLASS``, started by the module's runner.

The runner's messages come by standard input, which is a socket; the first one has the settings. Standard output and
error are the module's log.
"""

from __future__ import annotations

import importlib
import inspect
import json
import os
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from robot_client.devices.module import Module

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Those that ask the module to end."""

LONGEST_FAILURE = 300
"""Most characters of an exception's text in alerts and in the list of modules."""


class HostLink:
    """The connection to the runner. Reads block; writes may come from any thread."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._lines = connection.makefile("rb")
        self._lock = threading.Lock()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Messages, until the runner has left."""
        for line in self._lines:
            yield json.loads(line)

    def send(self, data: bytes) -> None:
        """Send one line."""
        with self._lock:
            self._connection.sendall(data)


class WrongSetting(Exception):
    """The settings name a class that can't be loaded, or give it wrong arguments."""


def load_class(path: str) -> type[Module]:
    """The class of a module.

    :param path: ``package.module:Class``
    :raises WrongSetting: there is no such class, or its file can't be imported
    """
    file, _, name = path.partition(":")
    if not name:
        raise WrongSetting(f"python = '{path}' names no class; write package.module:Class")
    sys.path.insert(0, str(Path.cwd()))
    try:
        found = getattr(importlib.import_module(file), name, None)
    except Exception as error:
        if not (isinstance(error, ModuleNotFoundError) and f"{file}.".startswith(f"{error.name}.")):
            # An error in the file itself: its line is in the log.
            traceback.print_exc()
        hint = f"; modules are looked for in folder = '{Path.cwd()}'" * isinstance(error, ImportError)
        raise WrongSetting(f"python = '{path}': {type(error).__name__}: {error}{hint}") from None
    if found is None:
        raise WrongSetting(f"python = '{path}': {file} has no class '{name}'")
    if not (isinstance(found, type) and issubclass(found, Module)):
        raise WrongSetting(f"python = '{path}': it is not a class that inherits robot_client.devices.Module")
    return found


def create(made: type[Module], settings: dict[str, Any]) -> Module:
    """Create a module with its settings.

    :raises WrongSetting: the class takes other arguments, or refuses a value by a ``ValueError``
    """
    signature = inspect.signature(made.__init__)
    try:
        signature.bind(None, **settings)
    except TypeError as error:
        taken = ", ".join(list(signature.parameters)[1:]) or "none"
        raise WrongSetting(f"settings: {error}; {made.__name__} takes {taken}") from None
    try:
        module: Module = made(**settings)
        return module
    except ValueError as error:
        traceback.print_exc()
        raise WrongSetting(f"settings: {error}") from None


def main() -> None:
    """Create the module, run it until a signal, stop it."""
    connection = socket.socket(fileno=os.dup(0))
    # Programs that the module starts must not read its commands.
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    link = HostLink(connection)
    messages = iter(link)
    try:
        _run(link, messages)
    except WrongSetting as error:
        _report_failure(link, str(error))
        raise SystemExit(str(error)) from None
    except Exception as error:
        text = str(error).partition("\n")[0]
        _report_failure(link, f"{type(error).__name__}{': ' * bool(text)}{text}"[:LONGEST_FAILURE])
        raise


def _report_failure(link: HostLink, text: str) -> None:
    # The runner may have been killed.
    with suppress(OSError):
        link.send(json.dumps({"failure": text}).encode() + b"\n")


def _run(link: HostLink, messages: Iterator[dict[str, Any]]) -> None:
    module = create(load_class(sys.argv[1]), next(messages)["settings"])
    module._core.send = link.send
    threading.excepthook = partial(_thread_failed, module)
    for number in SIGNALS:
        signal.signal(number, partial(_end, module))
    module._host_open()
    module.start()
    threading.Thread(target=_read, args=(module, messages), name="commands", daemon=True).start()
    # See PYTHON_READY. The module may have printed something without an end of line.
    sys.stdout.write("\nREADY\n")
    sys.stdout.flush()
    try:
        module._host_run()
    finally:
        module.stop()
        module._host_close()


def _thread_failed(module: Module, failure: threading.ExceptHookArgs) -> None:
    """An exception has ended a thread: raise it in the module's own, which ends the process."""
    module._host_post(partial(_raise, failure.exc_value))


def _raise(error: BaseException | None) -> None:
    if error is not None:
        raise error


def _end(module: Module, number: int, frame: object) -> None:
    # The module may be busy for long: the next signal ends the process at once.
    for each in SIGNALS:
        signal.signal(each, signal.SIG_DFL)
    module._host_end()


def _read(module: Module, messages: Iterator[dict[str, Any]]) -> None:
    for message in messages:
        module.call(module._host_receive, message)
    module._host_end()


if __name__ == "__main__":
    main()
