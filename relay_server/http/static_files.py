"""Files that do not change while the relay runs: read and compressed at the start, held once for all connections."""

from __future__ import annotations

import gzip
import hashlib
import mimetypes
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

from twisted.web.server import Request
from werkzeug.http import parse_accept_header

from relay_protocol.limits import KIB
from relay_server.http.limits import SharedBytes
from relay_server.http.problems import problem
from relay_server.http.request_fields import field, if_none_match
from relay_server.http.site import ReadOnly

ACCEPT_BYTES = 256
"""A longer ``Accept-Encoding`` is not parsed, and gets the file as it is."""

SMALL_BYTES = KIB
"""Smaller files are not compressed: they fit into one packet anyway."""

REVALIDATED = b"no-cache"
IMMUTABLE = b"public, max-age=31536000, immutable"


@cache
def _packed(content: bytes) -> bytes:
    """Compressed, or nothing if that saves little. All relays of a process have the same files."""
    if len(content) <= SMALL_BYTES:
        return b""
    packed = gzip.compress(content, 9, mtime=0)
    return packed if len(packed) < len(content) * 0.9 else b""


class StaticFile:
    """One file, also compressed if that makes it smaller.

    :param content_type: its media type; text gets a charset
    :param cache_control: the ``Cache-Control`` header
    :param headers: further headers
    """

    def __init__(
        self,
        content: bytes,
        content_type: str,
        cache_control: bytes = REVALIDATED,
        headers: Mapping[bytes, bytes] = MappingProxyType({}),
    ) -> None:
        self._headers = headers
        self._content = SharedBytes(content)
        charset = "; charset=utf-8" if content_type.startswith("text/") else ""
        self._content_type = (content_type + charset).encode()
        self._cache_control = cache_control
        self._tag = hashlib.sha256(content).hexdigest()[:24]
        self._gzip = SharedBytes(_packed(content))

    def answer(self, request: Request) -> bytes:
        """The file in the encoding that the client prefers (RFC 9110 section 12.5.3), or 304 if it has the file."""
        tags = {f'"{self._tag}"', f'"{self._tag}-gzip"'}
        packed = bool(self._gzip) and prefers_gzip(field(request, "accept-encoding"))
        request.setHeader(b"cache-control", self._cache_control)
        for name, value in self._headers.items():
            request.setHeader(name, value)
        # Each encoding needs an entity tag of its own (RFC 9110 section 8.8.3.3).
        request.setHeader(b"etag", f'"{self._tag}-gzip"' if packed else f'"{self._tag}"')
        if self._gzip:
            request.responseHeaders.addRawHeader(b"vary", b"accept-encoding")
        if tags & if_none_match(request):
            request.setResponseCode(304)
            return b""
        request.setHeader(b"content-type", self._content_type)
        if packed:
            request.setHeader(b"content-encoding", b"gzip")
        body = self._gzip if packed else self._content
        request.setHeader(b"content-length", b"%d" % len(body))
        return body


def prefers_gzip(accept: str | None) -> bool:
    """Whether a client with this ``Accept-Encoding`` prefers gzip to the uncompressed file."""
    if not accept or len(accept) > ACCEPT_BYTES:
        return False
    encodings = parse_accept_header(accept)
    quality = encodings.quality("gzip")
    named = any(name.lower() == "identity" for name, _ in encodings)
    return bool(quality > 0 and quality >= (encodings.quality("identity") if named else 0))


class Portal(ReadOnly):
    """The portal's files, and its page for all addresses that the portal itself routes.

    :param folder: the built portal
    """

    isLeaf = True
    PAGES = frozenset(
        {
            b"",
            b"login",
            b"fleet",
            b"cockpit",
            b"alerts",
            b"pipes",
            b"diagram",
            b"files",
            b"functions",
            b"realm",
        }
    )

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._files = _read(folder.resolve())

    def render_GET(self, request: Request) -> bytes:
        page = not request.postpath or request.postpath[0] in self.PAGES
        found = self._files.get(b"index.html" if page else b"/".join(request.postpath))
        if found is not None:
            return found.answer(request)
        if page:
            return problem(request, 503, "The portal is not built; run 'make web' and start the relay again.")
        return problem(request, 404, "There is nothing at this address.")


def _read(folder: Path) -> dict[bytes, StaticFile]:
    """The files below a folder by their paths. Links to files outside of it are ignored."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if not path.is_file() or not path.resolve().is_relative_to(folder):
            continue
        kind = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
        # Names under assets/ carry a hash of their content.
        cache = IMMUTABLE if path.parent.name == "assets" else REVALIDATED
        found[path.relative_to(folder).as_posix().encode()] = StaticFile(path.read_bytes(), kind, cache)
    return found
