"""Stores a stop for the next start of the daemon, and raises an alert while it can't be written."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

import msgspec
from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Unavailable
from robot_client.alerts import AlertCondition, OnAlert

STOP_FILE = "stopped.json"
GOALS_FILE = "goals.json"
MAX_BYTES = 64 * 1024
"""Most bytes of a record that are read; valid records are far shorter."""


class StopStore(Protocol):
    """Stores a stop, and which actions execute goals, for the next start of the daemon."""

    def load(self) -> link.Stopped | None:
        """The stored stop; ``None``: the robot is not stopped."""

    def store(self, stopped: link.Stopped) -> None:
        """Store a stop; returns when it is on the disk.

        :raises Unavailable: it can't be written
        """

    def clear(self) -> None:
        """Remove the stop; returns when that is on the disk.

        :raises Unavailable: it may still be there
        """

    def load_actions(self) -> list[str] | None:
        """The actions stored by :meth:`store_actions`; ``None``: they can't be read."""

    def store_actions(self, actions: list[str]) -> None:
        """Store which actions execute goals that move the robot.

        :raises Unavailable: they can't be written
        """


class MemoryStopStore(StopStore):
    """Stores a stop in memory, as long as the program runs."""

    def __init__(self, stopped: link.Stopped | None = None) -> None:
        self.stopped = stopped
        self.actions: list[str] | None = []

    def load(self) -> link.Stopped | None:
        return self.stopped

    def store(self, stopped: link.Stopped) -> None:
        self.stopped = stopped

    def clear(self) -> None:
        self.stopped = None

    def load_actions(self) -> list[str] | None:
        return self.actions

    def store_actions(self, actions: list[str]) -> None:
        self.actions = actions


class DiskStopStore(StopStore):
    """Stores a stop in the daemon's state folder.

    :param folder: must exist
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = folder / STOP_FILE
        self._goals_path = folder / GOALS_FILE

    def load(self) -> link.Stopped | None:
        """The stored stop; a file that can't be read counts as a stop."""
        try:
            with self._path.open("rb") as file:
                return msgspec.json.decode(file.read(MAX_BYTES), type=link.Stopped)
        except FileNotFoundError:
            return None
        except OSError as error:
            why = f"can't be read ({error.strerror})"
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            why = "is damaged"
        reason = f"the record of a stop, {self._path}, {why}, so the robot counts as stopped"
        return link.Stopped(by="the robot", since=self._modified_at(), why=reason)

    def store(self, stopped: link.Stopped) -> None:
        """Write a new file, then rename it over the old one."""
        pending = self._folder / (STOP_FILE + ".pending")
        try:
            handle = os.open(pending, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
            with os.fdopen(handle, "wb") as file:
                file.write(msgspec.json.encode(stopped) + b"\n")
                file.flush()
                os.fsync(file.fileno())
            pending.replace(self._path)
            self._sync_folder()
        except OSError as error:
            raise Unavailable(f"the stop can't be stored for the next start: {error.strerror}") from None

    def clear(self) -> None:
        """Remove the record."""
        try:
            self._path.unlink(missing_ok=True)
            self._sync_folder()
        except OSError as error:
            raise Unavailable(
                f"the record of the stop, {self._path}, can't be removed: {error.strerror}"
            ) from None

    def load_actions(self) -> list[str] | None:
        """See :class:`StopStore`."""
        try:
            with self._goals_path.open("rb") as file:
                return msgspec.json.decode(file.read(MAX_BYTES), type=list[str])
        except FileNotFoundError:
            return []
        except (OSError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return None

    def store_actions(self, actions: list[str]) -> None:
        """Write a new file, then rename it over the old one.

        It is not synced to the disk: a crash of the whole machine ends the goals as well.
        """
        pending = self._folder / (GOALS_FILE + ".pending")
        try:
            if not actions:
                self._goals_path.unlink(missing_ok=True)
                return
            handle = os.open(pending, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
            with os.fdopen(handle, "wb") as file:
                file.write(msgspec.json.encode(actions) + b"\n")
            pending.replace(self._goals_path)
        except OSError as error:
            raise Unavailable(
                f"which goals are under way can't be stored for the next start: {error.strerror}"
            ) from None

    def _modified_at(self) -> float:
        try:
            return self._path.lstat().st_mtime
        except OSError:
            return 0.0

    def _sync_folder(self) -> None:
        handle = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


class StopRecorder:
    """Stores a stop; failures become sentences and an alert.

    :param alert: receives the alert while a stop is not stored
    """

    def __init__(self, store: StopStore, alert: OnAlert) -> None:
        self.problem = ""
        """Sentence that says why the stop may not be on the disk; empty: it is."""
        self._store = store
        self._alert_condition = AlertCondition(alert, "stop", "record")
        self._log = Logger("motion")

    def store(self, stopped: link.Stopped) -> None:
        """Store a stop; :attr:`problem` says whether that failed."""
        self.problem = ""
        try:
            self._store.store(stopped)
        except Unavailable as error:
            self.problem = str(error)
        except Exception:  # the other parts of a stop must not depend on it
            self._log.failure("a stop could not be stored")
            self.problem = "the stop can't be stored for the next start; the robot's log says why"
        self._alert_condition.update(
            stopped_but([self.problem] if self.problem else []), "the stop is stored for the next start"
        )

    def clear(self) -> list[str]:
        """Remove the record; return sentences about what went wrong: then it may or may not be there."""
        try:
            self._store.clear()
        except Unavailable as error:
            return [str(error)]
        except Exception:
            self._log.failure("the record of a stop could not be removed")
            return ["the record of the stop can't be removed; the robot's log says why"]
        return []

    def end(self) -> None:
        """End the alert, as the robot is resumed."""
        self.problem = ""
        self._alert_condition.update("", "the robot is resumed")


def stopped_but(problems: list[str]) -> str:
    """The sentence about a stop with problems; empty where there are none."""
    return f"the robot is stopped, but {'; '.join(problems)}" if problems else ""
