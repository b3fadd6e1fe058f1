"""Serial devices, on a pseudo terminal: no byte is lost, and the device may disconnect and return."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from robot_client.devices import SerialDevice, SerialPort
from robot_client.devices.serial_device import LONGEST_LINE, WAITING_WRITES
from tests.worlds.serial_terminal import SerialTerminal
from tests.worlds.waiting import PATIENCE, wait_for


@pytest.fixture
def terminal(tmp_path: Path) -> SerialTerminal:
    return SerialTerminal(tmp_path)


class Seen:
    def __init__(self, path: Path) -> None:
        self.lines: list[bytes] = []
        self.open: list[bool] = []
        self.port = SerialPort(str(path), 115200, self.lines.append, self.open.append, keep=True)
        self.port.open()

    def is_open(self, times: int = 1) -> None:
        wait_for("the port is open", lambda: self.open[-1:] == [True] and self.open.count(True) == times)


@pytest.fixture
def seen(terminal: SerialTerminal) -> Iterator[Seen]:
    made = Seen(terminal.path)
    yield made
    made.port.close()


def all_came(seen: Seen, count: int) -> bool:
    return len(seen.lines) >= count


def test_no_bytes_are_lost_in_either_direction(terminal: SerialTerminal, seen: Seen) -> None:
    seen.is_open()
    lines = [b"%d %s" % (number, b"x" * (number % 90)) for number in range(1000)]
    for number, line in enumerate(lines, 1):
        terminal.send(line + b"\r\n")
        if number % 20 == 0:
            # The kernel's buffer has 4 KiB.
            wait_for("they came", partial(all_came, seen, number))
    assert seen.lines == lines
    sent = b"".join(b"%d\n" % number for number in range(200))
    for line in sent.splitlines(keepends=True):
        seen.port.write(line)
    assert terminal.reads(len(sent)) == sent


def test_a_port_has_one_user(
    terminal: SerialTerminal, seen: Seen, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two would each get a part of the lines."""
    seen.is_open()
    errors: list[str] = []

    def printed(words: str) -> bool:
        errors.append(capsys.readouterr().err)
        return words in "".join(errors)

    second = Seen(terminal.path)
    wait_for("the problem is in the log", lambda: printed("exclusively lock port"))
    terminal.send(b"whole\n")
    wait_for("a line", lambda: seen.lines == [b"whole"])
    assert second.open == []
    seen.port.close()
    second.is_open()
    wait_for("that is in the log too", lambda: printed(f"{terminal.path}: open\n"))
    second.port.close()


def test_device_that_comes_back_is_opened_again(
    terminal: SerialTerminal, seen: Seen, capsys: pytest.CaptureFixture[str]
) -> None:
    seen.is_open()
    terminal.unplug()
    wait_for("the port is closed", lambda: seen.open == [True, False])
    seen.port.write(b"kept")
    terminal.plug()
    seen.is_open(times=2)
    terminal.send(b"here\n")
    wait_for("a line", lambda: seen.lines == [b"here"])
    assert terminal.reads(4) == b"kept"
    assert capsys.readouterr().err.count("No such file") <= 1


def test_commands_that_must_not_be_late_are_dropped_while_the_device_is_gone(
    terminal: SerialTerminal,
) -> None:
    is_open: list[bool] = []
    port = SerialPort(str(terminal.path), 115200, print, is_open.append)
    port.open()
    wait_for("the port is open", lambda: is_open == [True])
    terminal.unplug()
    wait_for("the port is closed", lambda: is_open == [True, False])
    # More than the queue holds: none of them blocks.
    for _ in range(1000):
        port.write(b"late")
    terminal.plug()
    wait_for("the port is open", lambda: is_open == [True, False, True])
    port.write(b"new")
    assert terminal.reads(3) == b"new"
    port.close()


def test_command_that_the_writing_thread_has_taken_is_not_for_a_later_device(
    terminal: SerialTerminal,
) -> None:
    is_open: list[bool] = []
    taken, go_on = threading.Event(), threading.Event()

    class SlowQueue(queue.Queue[Any]):
        def get(self, block: bool = True, timeout: float | None = None) -> Any:
            item = super().get(block, timeout)
            taken.set()
            assert go_on.wait(PATIENCE)
            return item

    port = SerialPort(str(terminal.path), 115200, print, is_open.append)
    port._writes = SlowQueue(WAITING_WRITES)
    port.open()
    wait_for("the port is open", lambda: is_open == [True])
    port.write(b"late")
    assert taken.wait(PATIENCE)
    terminal.unplug()
    wait_for("the port is closed", lambda: is_open == [True, False])
    terminal.plug()
    wait_for("the port is open", lambda: is_open == [True, False, True])
    go_on.set()
    port.write(b"new")
    assert terminal.reads(3) == b"new"
    port.close()


def test_line_without_an_end_is_bounded(terminal: SerialTerminal, seen: Seen) -> None:
    seen.is_open()
    for _ in range(5):
        terminal.send(b"x" * 1000)
    wait_for("a piece", lambda: seen.lines)
    assert seen.lines == [b"x" * LONGEST_LINE]


def test_writes_do_not_block_while_the_device_is_gone(
    terminal: SerialTerminal, seen: Seen, capsys: pytest.CaptureFixture[str]
) -> None:
    seen.is_open()
    terminal.unplug()
    wait_for("the port is closed", lambda: seen.open == [True, False])
    # The writing thread may already have one.
    for number in range(2 * WAITING_WRITES):
        seen.port.write(b"%4d\n" % number)
    terminal.plug()
    seen.is_open(times=2)
    newest = b"".join(b"%4d\n" % number for number in range(WAITING_WRITES, 2 * WAITING_WRITES))
    wait_for("the newest", partial(ends_with, terminal, bytearray(), newest))
    assert capsys.readouterr().err.count("the oldest are dropped") == 1


def ends_with(terminal: SerialTerminal, received: bytearray, end: bytes) -> bool:
    received += os.read(terminal.own, 4096)
    return received.endswith(end)


@pytest.mark.parametrize("error", [TypeError, OSError, RuntimeError])
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_error_in_a_callback_is_no_error_of_the_device(
    terminal: SerialTerminal, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    def received(line: bytes) -> None:
        raise error

    failures: list[type[BaseException]] = []
    monkeypatch.setattr(threading, "excepthook", lambda failure: failures.append(failure.exc_type))
    is_open: list[bool] = []
    port = SerialPort(str(terminal.path), 115200, received, is_open.append)
    port.open()
    wait_for("the port is open", lambda: is_open == [True])
    terminal.send(b"line\n")
    wait_for("the error", lambda: failures == [error])
    port.close()


def test_closing_writes_what_waits(terminal: SerialTerminal) -> None:
    made = Seen(terminal.path)
    made.is_open()
    made.port.write(b"stop\n")
    made.port.close()
    assert terminal.reads(5) == b"stop\n"
    assert made.open == [True, False]


def test_port_that_never_opened_closes_at_once(tmp_path: Path) -> None:
    made = Seen(tmp_path / "none")
    made.port.write(b"x")
    made.port.close()
    assert made.open == []


def test_module_receives_lines_in_its_own_thread(terminal: SerialTerminal) -> None:
    class Scale(SerialDevice):
        def connected(self, is_open: bool) -> None:
            if is_open:
                self.write(b"begin\n")

        def received(self, line: bytes) -> None:
            got.append(line)
            self._host_end()

    def answer() -> None:
        # Opening drops earlier bytes.
        assert terminal.reads(6) == b"begin\n"
        terminal.send(b"12.5\n")

    got: list[bytes] = []
    device = threading.Thread(target=answer)
    device.start()
    scale = Scale(str(terminal.path))
    scale.start()
    scale._host_run()
    scale.stop()
    device.join()
    assert got == [b"12.5"]


class Gripper(SerialDevice):
    """Notes whether its device is open."""

    def start(self) -> None:
        self.open: list[bool] = []
        super().start()

    def connected(self, is_open: bool) -> None:
        self.open.append(is_open)


@pytest.mark.parametrize(("settings", "received"), [({}, b"new"), ({"keep": True}, b"late")])
def test_module_keeps_commands_for_a_device_that_is_gone_only_if_told_to(
    terminal: SerialTerminal, settings: dict[str, bool], received: bytes
) -> None:
    gripper = Gripper(str(terminal.path), **settings)
    gripper.start()
    thread = threading.Thread(target=gripper._host_run, daemon=True)
    thread.start()
    wait_for("the device is open", lambda: gripper.open == [True])
    terminal.unplug()
    wait_for("the device is gone", lambda: gripper.open == [True, False])
    gripper.write(b"late")
    terminal.plug()
    wait_for("the device is open", lambda: gripper.open == [True, False, True])
    gripper.write(b"new")
    assert terminal.reads(len(received)) == received
    gripper._host_end()
    thread.join()
    gripper.stop()
