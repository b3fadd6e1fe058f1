"""Which part of a file a request wants (RFC 9110 section 14)."""

from __future__ import annotations

from typing import NamedTuple

from twisted.web.server import Request
from werkzeug.http import parse_range_header


class Part(NamedTuple):
    """Bytes from ``start`` up to before ``stop``.

    :param ranged: whether the request named them
    """

    start: int
    stop: int
    ranged: bool

    def content_range(self, size: int) -> str:
        """The ``Content-Range`` of an answer with this part, of a file of so many bytes."""
        return f"bytes {self.start}-{self.stop - 1}/{size}"


def part_of(request: Request, size: int, tag: str) -> Part | None:
    """What a request wants of a file: all, or the one range it names; ``None`` when the file has nothing there.

    A ``Range`` that is not understood or names several ranges is passed over, as section 14.2 allows.

    :param size: of the file, bytes
    :param tag: the file's strong ``ETag``, with its quotes
    """
    whole = Part(0, size, False)
    if request.method != b"GET" or request.getHeader("if-range") not in (None, tag):
        return whole
    asked = parse_range_header(request.getHeader("range"))
    if asked is None or asked.units != "bytes" or len(asked.ranges) != 1:
        return whole
    start, stop = asked.ranges[0]
    if start < 0:
        # So many bytes from the end; all of a file that has less.
        start = max(0, size + start)
    return Part(start, min(size, size if stop is None else stop), True) if start < size else None
