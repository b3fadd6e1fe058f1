"""What can go wrong, told by whose fault it is.

::

    SwitchboardError
    ├── PeerError            the other end broke the contract
    │   ├── FrameTooLarge    a frame over the agreed limit; nothing was allocated
    │   └── MalformedMessage bytes that are no message of this protocol
    ├── Refused              the asker may not have what it asked for
    ├── NotFound             what was asked for does not exist, or must not be known to
    ├── Invalid              a value of the right form but the wrong content
    └── Unavailable          right and well-formed, but not possible now

``str(error)`` is a sentence for the person at the other end: it says what was wrong and, where that is not
plain, what to do. It never holds a secret, a path or a traceback.
"""


class SwitchboardError(Exception):
    """Anything the product reports in words."""

    code = "error"


class PeerError(SwitchboardError):
    """The other end broke the contract; the link can't be trusted any more."""

    code = "protocol_error"


class FrameTooLarge(PeerError):
    """A frame announces more bytes than the limit."""

    code = "frame_too_large"


class MalformedMessage(PeerError):
    """Bytes that are no message of this protocol."""

    code = "malformed"


class Refused(SwitchboardError):
    """The asker may not have what it asked for."""

    code = "refused"


class NotFound(SwitchboardError):
    """What was asked for does not exist for this asker."""

    code = "not_found"


class Invalid(SwitchboardError):
    """A value of the right form with content that can't be."""

    code = "invalid"


class Unavailable(SwitchboardError):
    """A rightful request that can't be served now; trying again later may help."""

    code = "unavailable"
