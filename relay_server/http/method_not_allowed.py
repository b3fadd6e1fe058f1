"""What an address answers to a method that it does not take (RFC 9110 section 15.5.6)."""

from __future__ import annotations

from collections.abc import Awaitable, Iterable
from typing import Any

from relay_protocol.errors import SwitchboardError


class WrongMethod(SwitchboardError):
    """What is at an address does not take this method.

    :ivar allow: those it takes, as ``Allow`` names them
    """

    code = "method_not_allowed"

    def __init__(self, takes: Iterable[str]) -> None:
        methods = set(takes)
        # HEAD works wherever GET does.
        self.allow = ", ".join(sorted(methods | ({"HEAD"} if "GET" in methods else set())))
        super().__init__(f"this address does not take that method; it takes {self.allow}")


async def not_taken(seen: Awaitable[Any], takes: Iterable[str]) -> None:
    """Refuse a method in the sight of who may know what is there: all others are told what they always are.

    :param seen: looks for it on behalf of who asks
    :param takes: the methods that it takes
    :raises NotFound: there is nothing, for who asks
    :raises WrongMethod: there is
    """
    await seen
    raise WrongMethod(takes)
