"""Python source made for one type, and what bounds it.

Definitions come from robots and are not to be trusted. Of their text only names of fields get into a source,
after they were checked, as string constants written by :func:`repr`; everything else (defaults, keys, formats) is
handed over as an object under a name made here. The size of a source is bounded.

Generated code is for messages that are as they should be. For all others it raises one of :data:`SURPRISES`,
and the closures, which know every case and can tell what was wrong, take the message instead.
"""

from __future__ import annotations

import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec

MAX_STEPS = 400
"""Most values a generated function handles one by one; larger types stay with the closures."""

MAX_LOOPS = 8
"""Deepest nesting of loops; Python itself takes 20, and 8 keep JSON within the depth that is allowed."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,254}")


class TooLarge(Exception):
    """A type for which no code is generated."""


class Unusual(ValueError):
    """A message that generated code leaves to the closures."""


SURPRISES = (struct.error, IndexError, ValueError, TypeError, OverflowError, msgspec.MsgspecError)
"""All that a message which is not as it should be can raise in generated code."""


class Source:
    """Lines of one function, and the objects they refer to."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._depth = 2
        self._loops = 0
        self._steps = 0
        self._made = 0
        self._objects: dict[str, Any] = {
            "SURPRISES": SURPRISES,
            "Unusual": Unusual,
        }

    def line(self, text: str) -> None:
        """One more statement."""
        self._lines.append("    " * self._depth + text)

    def first(self, text: str) -> None:
        """A statement before all others."""
        self._lines.insert(0, "        " + text)

    @contextmanager
    def block(self, head: str) -> Iterator[None]:
        """Statements inside ``head``, a loop or a condition."""
        self._loops += 1
        if self._loops > MAX_LOOPS:
            raise TooLarge
        self.line(head)
        self._depth += 1
        yield
        self._depth -= 1
        self._loops -= 1

    def step(self) -> None:
        """Count one value.

        :raises TooLarge: it was one too many
        """
        self._steps += 1
        if self._steps > MAX_STEPS:
            raise TooLarge

    def fresh(self) -> str:
        """A local name that no other value has."""
        self._made += 1
        return f"v{self._made}"

    def constant(self, value: Any) -> str:
        """A name for an object the code uses."""
        name = f"K{len(self._objects)}"
        self._objects[name] = value
        return name

    def function(self, arguments: str) -> Callable[[Callable[..., bytes]], Callable[..., bytes]]:
        """The function whose body the lines are.

        :returns: what takes the function for messages that raise any of :data:`SURPRISES`, with the same
            arguments, and gives the whole
        """
        text = "\n".join(
            [
                f"def convert({arguments}):",
                "    try:",
                *self._lines,
                "    except SURPRISES:",
                "        pass",
                f"    return slow({arguments})",
            ]
        )
        code = compile(text, "<generated>", "exec")

        def bind(slow: Callable[..., bytes]) -> Callable[..., bytes]:
            objects = {**self._objects, "slow": slow}
            exec(code, objects)  # noqa: S102 # its text was made here; see above
            function: Callable[..., bytes] = objects["convert"]
            return function

        return bind


def quoted(name: str) -> str:
    """A field's name as a string constant, checked once more.

    :raises TooLarge: it is no plain identifier, so no code is generated with it
    """
    if not _NAME.fullmatch(name):
        raise TooLarge
    return repr(name)


class Cursor(ABC):
    """How far generated code has got in a message, and the numbers that are taken in one go.

    CDR aligns to multiples of 2, 4 and 8 from the start of the body. Of the place in the body this knows the
    remainder ``rest`` when divided by ``known``: 8 up to the first text or sequence, 1 right behind a text.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.known = 8
        self.rest = 0
        self.codes: list[str] = []
        self.slots: list[str] = []

    def add(self, code: str, size: int, alignment: int, *slots: str) -> None:
        """Numbers (as :mod:`struct` writes them) that stand next."""
        self.align(alignment)
        self.codes.append(code)
        self.slots.extend(slots)
        self.rest = (self.rest + size) % self.known

    def align(self, alignment: int) -> None:
        """Pass over what fills up to a multiple of this."""
        if alignment > self.known:
            self.jump(alignment)
            self.known, self.rest = alignment, 0
        elif padding := -self.rest % alignment:
            self.codes.append(f"{padding}x")
            self.rest = (self.rest + padding) % self.known

    def lost(self, known: int) -> None:
        """From here on the place is only known as a multiple of this."""
        self.known, self.rest = known, 0

    def take(self) -> tuple[struct.Struct, list[str]] | None:
        """The numbers that wait, as one format with their slots; ``None`` when there are none."""
        if not self.codes:
            return None
        found = struct.Struct("<" + "".join(self.codes)), self.slots
        self.codes, self.slots = [], []
        return found

    @abstractmethod
    def jump(self, alignment: int) -> None:
        """Emit what aligns at run time."""
