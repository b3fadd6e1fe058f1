"""Modules that behave badly: ``python -u -m tests.worlds.hostile_module NAME``. Each prints ``up`` and runs on.

An alarm ends each process that a failed test leaves behind.
"""

from __future__ import annotations

import os
import signal
import sys
import time

STUBBORN = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def up() -> None:
    print("up", flush=True)


def ignores_signals() -> None:
    for each in STUBBORN:
        signal.signal(each, signal.SIG_IGN)
    up()


def closes_its_outputs() -> None:
    up()
    os.close(1)
    os.close(2)


def writes_binary_rubbish() -> None:
    up()
    while True:
        os.write(1, os.urandom(4000))
        os.write(2, b"\x1b[2J\x00\xff\r\n\xe2\x80\xa8{" * 10)
        time.sleep(0.05)


def leaves_its_process_group() -> None:
    """By a child in a session of its own, without the variables by which a run is known. It prints its pid."""
    if os.fork() == 0:
        os.setsid()
        ignores = "import os, signal, time; [signal.signal(each, signal.SIG_IGN) for each in (2, 15)]; "
        code = f"{ignores}signal.alarm(600); print(os.getpid()); print('up', flush=True); time.sleep(600)"
        os.execve(sys.executable, [sys.executable, "-c", code], {})


def floods_its_output() -> None:
    up()
    while True:
        os.write(1, b"x" * 65535 + b"\n")


def eats_memory() -> None:
    up()
    eaten = []
    while True:
        try:
            eaten.append(bytearray(2**24))
        except MemoryError:
            time.sleep(0.05)


def forks_a_tree() -> None:
    """Each process forks as often as it can, until 40 have been forked."""
    tokens, giver = os.pipe()
    os.write(giver, bytes(40))
    os.set_blocking(tokens, False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    up()
    try:
        while os.read(tokens, 1):
            os.fork()
    except BlockingIOError:
        pass


def forks_forever() -> None:
    """Processes that live for a moment, and leave a successor in a session of its own."""
    for each in STUBBORN:
        signal.signal(each, signal.SIG_IGN)
    up()
    until = time.monotonic() + 600
    for _ in range(3):
        if os.fork() == 0:
            while time.monotonic() < until:
                time.sleep(0.02)
                if os.fork():
                    os._exit(0)
                os.setsid()


HOSTILE = {
    each.__name__: each
    for each in (
        ignores_signals,
        closes_its_outputs,
        writes_binary_rubbish,
        leaves_its_process_group,
        floods_its_output,
        eats_memory,
        forks_a_tree,
        forks_forever,
    )
}

if __name__ == "__main__":
    signal.alarm(600)
    HOSTILE[sys.argv[1]]()
    time.sleep(600)
