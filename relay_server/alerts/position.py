"""Where a list of alerts ended, in words that whoever asks for the rest says back."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from relay_protocol.errors import Invalid

_FORM = re.compile(r"([0-9.e+-]{1,32})_([0-9A-Za-z]{1,32})\Z")


class Position(NamedTuple):
    """An alert, by what lists are sorted by; it need not be there any more.

    :param last: Unix seconds
    """

    last: float
    id: str

    def __str__(self) -> str:
        return f"{self.last!r}_{self.id}"

    @classmethod
    def parse(cls, text: str) -> Position:
        """Read one again.

        :raises Invalid: it is none
        """
        found = _FORM.match(text)
        try:
            last = math.nan if found is None else float(found[1])
        except ValueError:
            last = math.nan
        if found is None or not math.isfinite(last):
            raise Invalid("'before' is what an earlier answer gave as 'next'")
        return cls(last, found[2])
