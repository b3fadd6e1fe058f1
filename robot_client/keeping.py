"""The record of a stop, and that a person hears of it while there is none."""

from __future__ import annotations

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Unavailable
from robot_client.alerts import Concern, OnAlert
from robot_client.lasting import Latch


class Keeping:
    """Keeps a stop through a restart; whatever fails in that is words.

    :param alert: tells a person
    """

    def __init__(self, latch: Latch, alert: OnAlert) -> None:
        self.unkept = ""
        """Why the stop is not known to be on the disk; empty where it is."""
        self._latch = latch
        self._unlatched = Concern(alert, "stop", "record")
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
