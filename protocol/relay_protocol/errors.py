"""Exceptions, by whose fault they are.

::

    SwitchboardError
    ├── PeerError            the other end violated the protocol
    │   ├── FrameTooLarge    a frame over the agreed limit; nothing was allocated
    │   └── MalformedMessage bytes that are no message of this protocol
    ├── Refused              the caller lacks the right, or the request is not allowed
    ├── NotFound             the resource does not exist, or its existence is not disclosed
    ├── Invalid              a well-formed value that is not allowed
    └── Unavailable          a valid request that cannot be served now

``str(error)`` is shown to the user at the other end. It says what was wrong and, where that is not obvious, what to do.
It never contains a secret, a file path or a traceback.
"""


class SwitchboardError(Exception):
    """Base of all errors that are reported to users. ``code`` is machine-readable."""

    code = "error"


class PeerError(SwitchboardError):
    """The other end violated the protocol, and the link is closed."""

    code = "protocol_error"


class FrameTooLarge(PeerError):
    """A frame announces more bytes than the limit."""

    code = "frame_too_large"


class MalformedMessage(PeerError):
    """Bytes that are no message of this protocol."""

    code = "malformed"


class Refused(SwitchboardError):
    """The caller lacks the right, or the request is not allowed."""

    code = "refused"


class NotFound(SwitchboardError):
    """The resource does not exist for this caller."""

    code = "not_found"


class Invalid(SwitchboardError):
    """A well-formed value that is not allowed."""

    code = "invalid"


class Unavailable(SwitchboardError):
    """A valid request that cannot be served now; a later attempt may succeed."""

    code = "unavailable"
