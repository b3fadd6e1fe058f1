"""What the columns of several tables have in common."""

from __future__ import annotations

from typing import Annotated, Any

from sqlalchemy import Double, ForeignKey, String
from sqlalchemy.orm import mapped_column

NAME = 63
"""Longest name of a realm, user or group, in characters."""

SOURCE = 128
"""Longest name of who an event of the memory is from, and of an entry of the directory, in characters."""

LABEL = 255
"""Longest free text for people (labels, descriptions, targets of audit entries), in characters."""

Key = Annotated[int, mapped_column(primary_key=True)]
Name = Annotated[str, mapped_column(String(NAME))]
Label = Annotated[str, mapped_column(String(LABEL))]
Seconds = Annotated[float, mapped_column(Double)]
Digest = Annotated[str, mapped_column(String(64))]
"""A SHA-256 in hex."""

NO_REUSE = {"sqlite_autoincrement": True}


def owned_by(column: str, *, index: bool = True) -> Any:
    """A foreign key whose rows go with what they belong to.

    :param index: false where a unique constraint begins with the column
    """
    return mapped_column(ForeignKey(column, ondelete="CASCADE"), index=index)
