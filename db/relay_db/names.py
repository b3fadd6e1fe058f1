"""What users, groups and realms may be called, and what free text is kept as."""

from __future__ import annotations

import re
import unicodedata

from relay_db.models import LABEL, NAME
from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME_BYTES
from relay_protocol.realms import full_name, parted
from relay_protocol.text import legible

_HEX = re.compile(r"[0-9a-f]{1,64}\Z")


def normal_name(text: str, what: str = "name") -> str:
    """The one form of a name: NFKC, lower case. ``Ann`` and ``ann`` are the same person.

    :param what: whose name it is, for the error
    :raises Invalid: empty, over 63 characters, not :func:`legible`, with blanks or ``@``, or beginning with ``-``
    """
    # Normalising takes quadratic time where many marks stand on one letter.
    if len(text) > NAME_BYTES or len(text.encode("utf-8", "surrogatepass")) > NAME_BYTES:
        raise Invalid(f"the {what} must have 1 to {NAME} characters, and {NAME_BYTES} bytes at most")
    name = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", text).casefold())
    if not 0 < len(name) <= NAME:
        raise Invalid(f"the {what} must have 1 to {NAME} characters")
    if not legible(name) or any(character.isspace() for character in name):
        raise Invalid(
            f"the {what} must be printable, without spaces, line breaks, control characters and U+FFFD, which "
            "stands for bytes that are no text"
        )
    if "@" in name:
        raise Invalid(f"the {what} must not have an '@' in it: what follows one is a realm, as in toad@lab1")
    if name[0] == "-":
        raise Invalid(f"the {what} must not begin with '-'")
    return name


def normalise(text: str) -> str:
    """A name to look for. One that can't be is looked for as the empty one, which nobody has.

    Text from anywhere must not reach the database as it is: PostgreSQL fails on NUL and on half characters.
    """
    try:
        return normal_name(text)
    except Invalid:
        return ""


def full_name_of(text: str) -> str:
    """The one name by which the whole relay knows somebody or something, however its realm is written.

    :param text: as ``mobile@Lab2``
    """
    name, realm = parted(text)
    return full_name(name, normalise(realm) or realm)


def findable_hex(text: str) -> str:
    """A fingerprint or hash to look for; what can't be one is looked for as the empty one."""
    return text if _HEX.match(text) else ""


def label(text: str, what: str) -> str:
    """Free text of one line that a person gave, checked.

    :raises Invalid: over 255 characters, or not :func:`legible`
    """
    if len(text) > LABEL or not legible(text):
        raise Invalid(f"the {what} must be one printable line of at most {LABEL} characters")
    return text


def sanitise(text: str, length: int = LABEL) -> str:
    """Text from anyone, made fit to be kept: what can't be printed is escaped, what is too long is cut."""
    printable = "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text[:length]
    )
    if len(text) <= length and len(printable) <= length:
        return printable
    return printable[: length - 1] + "…"
