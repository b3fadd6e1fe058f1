"""The record of a stop, and that a person hears of it while there is none."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

import msgspec
from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Unavailable
from robot_client.alerts import AlertCondition, OnAlert

FILE = "stopped.json"
GOALS = "goals.json"
MOST = 64 * 1024
"""Bytes of a record that are read; ours are far shorter."""


class StopStore(Protocol):
    """Where a stop is kept."""

    def load(self) -> link.Stopped | None:
        """The stop that was kept; ``None`` where there is none."""

    def keep(self, stopped: link.Stopped) -> None:
        """Keep a stop; done when it is on the disk.

        :raises Unavailable: it can't be kept
        """

    def clear(self) -> None:
        """Keep none; done when that is on the disk.

        :raises Unavailable: it is still there
        """

    def goals(self) -> list[str] | None:
        """The actions that were kept by :meth:`keep_goals`; ``None`` where nobody can tell which."""

    def keep_goals(self, actions: list[str]) -> None:
        """Keep which actions pursue goals that move the robot.

        :raises Unavailable: they can't be kept
        """


class MemoryStopStore(StopStore):
    """Keeps it as long as the program runs."""

    def __init__(self, stopped: link.Stopped | None = None) -> None:
        self.stopped = stopped
        self.noted: list[str] | None = []

    def load(self) -> link.Stopped | None:
        """The stop that was kept."""
        return self.stopped

    def keep(self, stopped: link.Stopped) -> None:
        """Keep a stop."""
        self.stopped = stopped

    def clear(self) -> None:
        """Keep none."""
        self.stopped = None

    def goals(self) -> list[str] | None:
        """The actions that were kept."""
        return self.noted

    def keep_goals(self, actions: list[str]) -> None:
        """Keep which actions pursue goals."""
        self.noted = actions


class DiskStopStore(StopStore):
    """Keeps it in the daemon's state folder.

    :param folder: is there
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = folder / FILE
        self._goals = folder / GOALS

    def load(self) -> link.Stopped | None:
        """The stop that was kept; what can't be read counts as one."""
        try:
            with self._path.open("rb") as file:
                return msgspec.json.decode(file.read(MOST), type=link.Stopped)
        except FileNotFoundError:
            return None
        except OSError as error:
            why = f"can't be read ({error.strerror})"
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            why = "is damaged"
        reason = f"the record of a stop, {self._path}, {why}, so the robot counts as stopped"
        return link.Stopped(by="the robot", since=self._since(), why=reason)

    def keep(self, stopped: link.Stopped) -> None:
        """Write it beside the old one, then put it in its place."""
        pending = self._folder / (FILE + ".pending")
        try:
            handle = os.open(pending, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
            with os.fdopen(handle, "wb") as file:
                file.write(msgspec.json.encode(stopped) + b"\n")
                file.flush()
                os.fsync(file.fileno())
            pending.replace(self._path)
            self._sync()
        except OSError as error:
            raise Unavailable(f"the stop can't be kept through a restart: {error.strerror}") from None

    def clear(self) -> None:
        """Take the record away."""
        try:
            self._path.unlink(missing_ok=True)
            self._sync()
        except OSError as error:
            raise Unavailable(
                f"the record of the stop, {self._path}, can't be taken away: {error.strerror}"
            ) from None

    def goals(self) -> list[str] | None:
        """The actions that were kept."""
        try:
            with self._goals.open("rb") as file:
                return msgspec.json.decode(file.read(MOST), type=list[str])
        except FileNotFoundError:
            return []
        except (OSError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return None

    def keep_goals(self, actions: list[str]) -> None:
        """Write them beside the old ones, then put them in their place.

        Nobody waits for the disk: when the whole machine goes, its goals go with it.
        """
        pending = self._folder / (GOALS + ".pending")
        try:
            if not actions:
                self._goals.unlink(missing_ok=True)
                return
            handle = os.open(pending, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
            with os.fdopen(handle, "wb") as file:
                file.write(msgspec.json.encode(actions) + b"\n")
            pending.replace(self._goals)
        except OSError as error:
            raise Unavailable(
                f"which goals are under way can't be kept through a restart: {error.strerror}"
            ) from None

    def _since(self) -> float:
        try:
            return self._path.lstat().st_mtime
        except OSError:
            return 0.0

    def _sync(self) -> None:
        handle = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


class StopRecorder:
    """Keeps a stop through a restart; whatever fails in that is words.

    :param alert: tells a person
    """

    def __init__(self, latch: StopStore, alert: OnAlert) -> None:
        self.unkept = ""
        """Why the stop is not known to be on the disk; empty where it is."""
        self._latch = latch
        self._unlatched = AlertCondition(alert, "stop", "record")
        self._log = Logger("helm")

    def keep(self, stopped: link.Stopped) -> None:
        """Keep it; :attr:`unkept` says whether that was in vain."""
        self.unkept = ""
        try:
            self._latch.keep(stopped)
        except Unavailable as error:
            self.unkept = str(error)
        except Exception:  # the rest of the stop must not hang on it
            self._log.failure("a stop could not be kept")
            self.unkept = "the stop can't be kept through a restart; the robot's log says why"
        self._unlatched.tell(but([self.unkept] if self.unkept else []), "the stop is kept through a restart")

    def clear(self) -> list[str]:
        """Take the record away; what went wrong, in words: it may be there or not."""
        try:
            self._latch.clear()
        except Unavailable as error:
            return [str(error)]
        except Exception:
            self._log.failure("the record of a stop could not be taken away")
            return ["the record of the stop can't be taken away; the robot's log says why"]
        return []

    def end(self) -> None:
        """The robot is resumed."""
        self.unkept = ""
        self._unlatched.tell("", "the robot is resumed")


def but(problems: list[str]) -> str:
    """What is told of a stop with which something is wrong; empty for nothing."""
    return f"the robot is stopped, but {'; '.join(problems)}" if problems else ""
