"""Runs a module's class by hand, without daemon and relay: ``python -m robot_client.devices.trial CLASS [SETTINGS]``.

CLASS is ``package.module:Class``, SETTINGS its arguments as JSON. Each line of standard input is a command, as JSON;
answers and feedback go to standard output, as the module's own output does. The robot counts as not stopped. The end
of the input, or Ctrl-C, stops the module.
"""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from relay_protocol.command_output import written_output

ANSWER_SECONDS = 10.0
"""Seconds that each command's answer is waited for at the end of the input."""


def main() -> None:
    """Run a class until the input ends.

    :raises SystemExit: with the exit code of the module
    """
    with written_output():
        _run()


def _run() -> None:
    if len(sys.argv) not in (2, 3):
        raise SystemExit(
            """usage: python -m robot_client.devices.trial PACKAGE.MODULE:CLASS ['{"port": "/dev/ttyUSB0"}']"""
        )
    path = sys.argv[1]
    try:
        settings = json.loads(sys.argv[2] if len(sys.argv) == 3 else "{}")
    except ValueError as error:
        raise SystemExit(f"the settings are not JSON: {error}") from None
    own, other = socket.socketpair()
    with (
        own,
        subprocess.Popen(
            [sys.executable, "-u", "-m", "robot_client.devices.host", path], stdin=other.fileno()
        ) as host,
    ):
        other.close()
        # Ctrl-C reaches the module as well, which ends by it.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        _send(own, {"settings": settings})
        _send(own, {"stopped": False})
        answers = threading.Semaphore(0)
        threading.Thread(target=_print_messages, args=(own, answers), daemon=True).start()
        threading.Thread(target=_send_commands, args=(own, sys.stdin, answers), daemon=True).start()
        code = host.wait()
    raise SystemExit(code)


def _send(connection: socket.socket, message: dict[str, Any]) -> None:
    connection.sendall(json.dumps(message).encode() + b"\n")


def _send_commands(connection: socket.socket, lines: Iterable[str], answers: threading.Semaphore) -> None:
    sent = 0
    with suppress(OSError):
        for number, line in enumerate(lines, 1):
            if not line.strip():
                continue
            try:
                command = json.loads(line)
            except ValueError as error:
                _print(f"this is not JSON: {error}")
                continue
            _send(connection, {"command": command, "number": number, "sender": 1})
            sent += 1
        for _ in range(sent):
            answers.acquire(timeout=ANSWER_SECONDS)
        # The module ends as it would without its runner.
        connection.shutdown(socket.SHUT_WR)


def _print_messages(connection: socket.socket, answers: threading.Semaphore) -> None:
    with suppress(OSError):
        for line in connection.makefile():
            message = json.loads(line)
            if "feedback" in message:
                _print(f"feedback: {json.dumps(message['feedback'])}")
            elif "answer" in message:
                _print(f"answer: {message['error'] or 'done'}")
                answers.release()


def _print(line: str) -> None:
    # One write at once: threads and the module share the output.
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
