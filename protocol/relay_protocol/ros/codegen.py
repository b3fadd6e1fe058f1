"""Builds Python functions for single types, for :mod:`generated_cdr_to_json` and :mod:`generated_json_to_cdr`.

Definitions come from robots and are not trusted. Only field names get into the source text; they are checked and
written by :func:`repr`. Defaults, keys and formats are passed as objects. The size of the source is bounded.

Generated code converts well-formed messages. For all others it raises one of :data:`SLOW_PATH_ERRORS`. The slow path
(:mod:`relay_protocol.ros.cdr_to_json`, :mod:`relay_protocol.ros.json_to_cdr`) then converts the message, or says
what is wrong with it.
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
"""Most values that a generated function converts one by one; larger types use the slow path only."""

MAX_LOOPS = 8
"""Deepest nesting of loops. Python allows 20; 8 keep JSON within its permitted depth."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,254}")


class TooLarge(Exception):
    """The type is too large to generate code for."""


class UseSlowPath(ValueError):
    """Raised by generated code for a message that the slow path must convert."""


SLOW_PATH_ERRORS = (struct.error, IndexError, ValueError, TypeError, OverflowError, msgspec.MsgspecError)
"""Everything generated code can raise for an unusual or invalid message."""


class FunctionBuilder:
    """Collects the lines of one function and the objects they use."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._depth = 2
        self._loops = 0
        self._steps = 0
        self._variables = 0
        self._objects: dict[str, Any] = {
            "SLOW_PATH_ERRORS": SLOW_PATH_ERRORS,
            "UseSlowPath": UseSlowPath,
        }

    def line(self, text: str) -> None:
        """Append a statement."""
        self._lines.append("    " * self._depth + text)

    def prepend(self, text: str) -> None:
        """Insert a statement before all others."""
        self._lines.insert(0, "        " + text)

    @contextmanager
    def block(self, head: str) -> Iterator[None]:
        """Statements added inside are indented below ``head``, a loop or a condition."""
        self._loops += 1
        if self._loops > MAX_LOOPS:
            raise TooLarge
        self.line(head)
        self._depth += 1
        yield
        self._depth -= 1
        self._loops -= 1

    def count_value(self) -> None:
        """Count one converted value.

        :raises TooLarge: more than :data:`MAX_STEPS`
        """
        self._steps += 1
        if self._steps > MAX_STEPS:
            raise TooLarge

    def new_variable(self) -> str:
        """A new local name."""
        self._variables += 1
        return f"v{self._variables}"

    def constant(self, value: Any) -> str:
        """A global name for an object the code uses."""
        name = f"K{len(self._objects)}"
        self._objects[name] = value
        return name

    def function(self, *parameters: str) -> Callable[[Callable[..., bytes]], Callable[..., bytes]]:
        """Compile the function.

        :param parameters: names, with default values if they have some: ``now=0``
        :returns: takes the slow path, a function with the same arguments, and returns the complete function
        """
        names = ", ".join(each.partition("=")[0] for each in parameters)
        text = "\n".join(
            [
                f"def convert({', '.join(parameters)}):",
                "    try:",
                *self._lines,
                "    except SLOW_PATH_ERRORS:",
                "        pass",
                f"    return slow({names})",
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
    """A field name as a string constant, checked once more.

    :raises TooLarge: not a plain identifier; no code is generated then
    """
    if not _NAME.fullmatch(name):
        raise TooLarge
    return repr(name)


class CodeGenerator(ABC):
    """Tracks the position in the message while code is generated, and joins neighbouring numbers into one format.

    CDR aligns to multiples of 2, 4 and 8 from the start of the body. The position is known as ``remainder`` modulo
    ``alignment``: 8 up to the first text or sequence, 1 right after a text.
    """

    def __init__(self, source: FunctionBuilder) -> None:
        self.source = source
        self.alignment = 8
        self.remainder = 0
        self.codes: list[str] = []
        self.slots: list[str] = []

    def add(self, code: str, size: int, alignment: int, *slots: str) -> None:
        """Append numbers in a format of :mod:`struct`."""
        self.align(alignment)
        self.codes.append(code)
        self.slots.extend(slots)
        self.remainder = (self.remainder + size) % self.alignment

    def align(self, alignment: int) -> None:
        """Skip padding up to a multiple of this."""
        if alignment > self.alignment:
            self.emit_alignment(alignment)
            self.alignment, self.remainder = alignment, 0
        elif padding := -self.remainder % alignment:
            self.codes.append(f"{padding}x")
            self.remainder = (self.remainder + padding) % self.alignment

    def set_alignment(self, alignment: int) -> None:
        """From here on the position is only known as a multiple of this."""
        self.alignment, self.remainder = alignment, 0

    def take_format(self) -> tuple[struct.Struct, list[str]] | None:
        """The pending numbers as one format with their variables; ``None`` when there are none."""
        if not self.codes:
            return None
        found = struct.Struct("<" + "".join(self.codes)), self.slots
        self.codes, self.slots = [], []
        return found

    @abstractmethod
    def emit_alignment(self, alignment: int) -> None:
        """Emit code that aligns at run time."""
