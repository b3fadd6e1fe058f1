"""Normal forms of names and free text before they are stored or searched."""

from __future__ import annotations

import re
import unicodedata

from relay_db.models import LABEL, NAME
from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME_BYTES
from relay_protocol.realms import full_name, split_name
from relay_protocol.text import is_printable

_HEX = re.compile(r"[0-9a-f]{1,64}\Z")


def normal_name(text: str, what: str = "name") -> str:
    """The normal form of a name: NFKC, lower case. ``Ann`` and ``ann`` are the same user.

    :param what: words for the name in errors
    :raises Invalid: empty, over 63 characters, not :func:`is_printable`, with blanks or ``@``, or beginning with ``-``
    """
    # Normalising takes quadratic time if one letter has many combining marks.
    if len(text) > NAME_BYTES or len(text.encode("utf-8", "surrogatepass")) > NAME_BYTES:
        raise Invalid(f"the {what} must have 1 to {NAME} characters, and {NAME_BYTES} bytes at most")
    name = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", text).casefold())
    if not 0 < len(name) <= NAME:
        raise Invalid(f"the {what} must have 1 to {NAME} characters")
    if not is_printable(name) or any(character.isspace() for character in name):
        raise Invalid(
            f"the {what} must be printable, without spaces, line breaks, control characters and U+FFFD, which "
            "stands for bytes that are no text"
        )
    if "@" in name:
        raise Invalid(f"the {what} must not contain '@', which separates the realm, as in toad@lab1")
    if name[0] == "-":
        raise Invalid(f"the {what} must not begin with '-'")
    return name


def normalise(text: str) -> str:
    """The normal form of a name to search for; empty, which matches nothing, if the name is not valid.

    Text from the network must not reach the database unchecked: PostgreSQL fails on NUL and lone surrogates.
    """
    try:
        return normal_name(text)
    except Invalid:
        return ""


def full_name_of(text: str) -> str:
    """The full name of a user, group or robot, with its realm in normal form.

    :param text: as ``mobile@Lab2``
    """
    name, realm = split_name(text)
    return full_name(name, normalise(realm) or realm)


def normalise_hex(text: str) -> str:
    """A fingerprint or hash to search for; empty, which matches nothing, if it is not valid."""
    return text if _HEX.match(text) else ""


def checked_label(text: str, what: str) -> str:
    """Check free text of one line.

    :raises Invalid: over 255 characters, or not :func:`is_printable`
    """
    if len(text) > LABEL or not is_printable(text):
        raise Invalid(f"the {what} must be one printable line of at most {LABEL} characters")
    return text


def sanitise(text: str, length: int = LABEL) -> str:
    """Text that can be stored: unprintable characters are escaped, and long text is cut."""
    printable = "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text[:length]
    )
    if len(text) <= length and len(printable) <= length:
        return printable
    return printable[: length - 1] + "…"
