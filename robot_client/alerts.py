"""How parts of the daemon tell a person something."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple, Protocol

from relay_protocol import link

HEARING_NS = 5_000_000_000
"""A daemon has so long to hear what is wrong before it says that it has told all: diagnostics come once a second."""

KEPT = 300
"""Most alerts that are remembered while they last, and most words that may have to be said again."""


class OnAlert(Protocol):
    """Who is told."""

    def __call__(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        """Something a person should know (SPEC section 2.4, ``alert``).

        :param level: ``info``, ``warning`` or ``error``
        :param kind: ``module``, ``diagnostics``, …
        :param about: the part of the robot
        :param over: what was told under this kind and part is well again
        """


def nobody(level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
    """Nobody is there to be told."""


class AlertCondition:
    """One thing that may be wrong for a while: a person hears when it begins, when it is another, and when it is over.

    :param alert: tells a person
    :param kind: what it is about, as for :class:`OnAlert`
    :param about: the part of the robot
    """

    def __init__(self, alert: OnAlert, kind: str, about: str) -> None:
        self.words = ""
        """What was told and lasts; empty for nothing."""
        self._alert = alert
        self._kind = kind
        self._about = about

    def tell(self, words: str, well: str) -> None:
        """Tell what is wrong now, if that is news.

        :param words: empty for nothing
        :param well: what is said of it when it is over
        """
        told, self.words = self.words, words
        if words and words != told:
            self._alert("error", words, self._kind, self._about)
        elif told and not words:
            self._alert("info", well, self._kind, self._about, over=True)


MODULE = "module"
"""Kind of what is told of the daemon's own parts."""

CONTROL = "control"
"""Kind of a loss of control while the robot moved. Of no part it has happened and does not last: once heard it is told
no more."""


class Reach(Protocol):
    """What is asked of the control link."""

    @property
    def registered(self) -> bool:
        """Whether the relay knows us now."""

    @property
    def answered(self) -> int | None:
        """When the latest ping that the relay has answered was sent, nanoseconds."""

    def say(self, message: link.Message) -> None:
        """Send a message."""


class _Word(NamedTuple):
    """Something that was told, and when it was said into a link, nanoseconds; ``None``: not yet."""

    message: link.Alert
    said: int | None


class AlertMemory:
    """Tells the relay, and at each registration again what lasts and what the relay may not have heard.

    A link may be dead for seconds before that is known. What was said before a ping that was answered has arrived.

    :param now: the clock of ``reach.answered``, nanoseconds
    """

    def __init__(self, reach: Reach, now: Callable[[], int]) -> None:
        self._reach = reach
        self._now = now
        self._lasting: dict[tuple[str, str], link.Alert] = {}
        self._doubtful: deque[_Word] = deque(maxlen=KEPT)
        self._began = now()
        self._owes = False
        """Whether the relay is still to be told, in this registration, that this was all."""
        self._whole = True
        """Whether all that lasts is remembered."""

    def tell(self, message: link.Alert) -> None:
        """Say it now if the relay is there, and later if it was not."""
        self._forget()
        if message.kind and (message.kind, message.about) != (CONTROL, ""):
            self._remember(message)
        registered = self._reach.registered
        self._doubtful.append(_Word(message, self._now() if registered else None))
        if registered:
            self._reach.say(message)

    def look(self) -> None:
        """Forget what has arrived, and say what is due; to be called now and then."""
        self._forget()
        self._say_that_is_all()

    def _forget(self) -> None:
        answered = self._reach.answered
        while answered is not None and self._doubtful:
            said = self._doubtful[0].said
            if said is None or said >= answered:
                return
            self._doubtful.popleft()

    def registered(self) -> None:
        """The relay knows us again, or another one does: tell all that lasts (SPEC section 2.4, ``alerts_told``)."""
        doubtful = [each.message for each in self._doubtful]
        lasting = [each for each in self._lasting.values() if each not in doubtful]
        self._doubtful.clear()
        for message in (*lasting, *doubtful):
            self._doubtful.append(_Word(message, self._now()))
            self._reach.say(message)
        self._owes = self._whole
        self._say_that_is_all()

    def _say_that_is_all(self) -> None:
        """Not before what is wrong can have been heard: what is not told by then is over for the relay."""
        heard = self._now() - self._began >= HEARING_NS
        if self._owes and heard and self._reach.registered:
            self._owes = False
            self._reach.say(link.AlertsTold())

    def _remember(self, message: link.Alert) -> None:
        key = (message.kind, message.about)
        if message.over:
            self._lasting.pop(key, None)
            self._whole = self._whole or not self._lasting
            # Who heard that it began and that it is over must not hear again that it began.
            rest = [each for each in self._doubtful if each.said is None or not _same(each.message, message)]
            self._doubtful = deque(rest, KEPT)
        elif key in self._lasting or len(self._lasting) < KEPT:
            self._lasting[key] = message
        else:
            self._whole = False


def _same(one: link.Alert, other: link.Alert) -> bool:
    return (one.kind, one.about) == (other.kind, other.about)
