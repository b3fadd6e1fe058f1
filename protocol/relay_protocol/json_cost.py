"""How much there is to do for a large JSON text, counted in C before anything reads it.

One thread reads for everybody, and Python objects are made of what is read. So a large message is one for a large
string (base64) or a long list of numbers, and not for a hundred thousand objects. Each count is an upper bound of what
a parser will find, up to what stands in strings; what is beyond the limits is refused unread.
"""

from __future__ import annotations

from typing import NamedTuple

from relay_protocol.errors import Invalid
from relay_protocol.limits import KIB, MIB

COUNTED = 64 * KIB
"""Bytes up to which nothing is counted."""


class Limits(NamedTuple):
    """What a text may hold.

    :param containers: objects and arrays
    :param strings: with names of fields
    :param values: commas
    """

    containers: int
    strings: int
    values: int


LARGE = 1 * MIB
UP_TO_LARGE = Limits(49_152, 131_072, 1_050_000)
"""For texts of at most :data:`LARGE` bytes. A path of 6800 poses fits."""

BEYOND = Limits(4096, 16_384, 1_050_000)
"""For longer ones: to look through their bytes takes time, too."""

ODD_VALUES, ODD_OBJECTS = 131_072, 16_384
"""Commas, and braces, of a text with values that are not simply those of their fields' types: each takes ten times as
long."""

ESCAPES_BEYOND = 131_072
"""Backslashes of a text of more than :data:`LARGE` bytes with NaN or infinity, which are looked for outside strings."""

LONG_NUMBER = 320
"""Digits of a number from which on it is not read in a text of more than :data:`COUNTED` bytes: that takes quadratic
time. No type holds such a number: the largest of a float64 has 309 digits before the point."""

_STRIDE = 31
_SAMPLED = b"0" * (LONG_NUMBER // _STRIDE)
"""What is left of a long number in a sample of every 31st byte."""

_LONG_RUN = b"0" * LONG_NUMBER
_DIGITS_ALIKE = bytes.maketrans(b"123456789", b"000000000")

_WORDS = ("objects and arrays", "strings and names of fields", "values (commas)")


class TooCostly(Invalid):
    """To read a JSON text would hold up everybody else."""

    code = "too_costly"


def check(data: bytes) -> None:
    """Refuse a JSON text that takes too long to read.

    :raises TooCostly: with what there is too much of
    """
    if len(data) > COUNTED and (found := excess(data)) is not None:
        raise TooCostly(found)


def excess(data: bytes) -> str | None:
    """What a JSON text has too much of, in words."""
    size = len(data)
    if size <= COUNTED:
        return None
    most = UP_TO_LARGE if size <= LARGE else BEYOND
    # An escaped quotation mark is a part of a string; after two backslashes it may be the end of one.
    strings = data.count(b'"')
    if strings > most.strings:
        strings -= data.count(b'\\"') - data.count(b'\\\\"')
    found = Limits(data.count(b"{") + data.count(b"["), strings // 2, data.count(b","))
    for count, limit, what in zip(found, most, _WORDS, strict=True):
        if count > limit:
            return f"a message of {size} bytes may have {limit} {what}, not {count}; send bulk as base64, or less"
    if has_long_numbers(data):
        return f"a message of {size} bytes may have no number of {LONG_NUMBER} digits or more"
    return None


def has_long_numbers(data: bytes) -> bool:
    """Whether a JSON text of more than :data:`COUNTED` bytes has a number of :data:`LONG_NUMBER` digits or more."""
    # A sample rules out nearly all texts in a twentieth of the time.
    if len(data) <= COUNTED or _SAMPLED not in data[::_STRIDE].translate(_DIGITS_ALIKE):
        return False
    if _LONG_RUN not in data.translate(_DIGITS_ALIKE):
        return False
    return _LONG_RUN in outside_strings(data).translate(_DIGITS_ALIKE)


def outside_strings(data: bytes) -> bytes:
    """A JSON text without the contents of its strings, in linear time with loops in C."""
    if b"\\" in data:
        data = data.replace(b"\\\\", b"").replace(b'\\"', b"")
    return b'"'.join(data.split(b'"')[::2])


def check_odd(data: bytes) -> None:
    """Refuse a JSON text with too much in it to look at its values one by one.

    :raises TooCostly: it has more than :data:`ODD_VALUES` or :data:`ODD_OBJECTS`
    """
    if len(data) > COUNTED and (data.count(b",") > ODD_VALUES or data.count(b"{") > ODD_OBJECTS):
        raise TooCostly(
            f"of more than {ODD_VALUES} values, or {ODD_OBJECTS} objects, one does not fit its type, or is null, NaN, "
            "infinite, or an integer written with a point; send all in their fields' types, or fewer at once"
        )


def check_literals(data: bytes) -> None:
    """Refuse a text with NaN or infinity that takes too long to mark these.

    :raises TooCostly: as :func:`check_odd`, or it is large and has more than :data:`ESCAPES_BEYOND` backslashes
    """
    if len(data) > LARGE and _has_more_escapes_than(ESCAPES_BEYOND, data):
        raise TooCostly(
            f"a message of more than {LARGE} bytes with NaN or infinity may have {ESCAPES_BEYOND} backslashes; send "
            "texts or numbers alone, or less"
        )
    check_odd(data)


def _has_more_escapes_than(most: int, data: bytes) -> bool:
    """Counts by the megabyte, as to count millions takes long."""
    for at in range(0, len(data), MIB):
        most -= data.count(b"\\", at, at + MIB)
        if most < 0:
            return True
    return False
