"""What is asked of the directory, and what comes of it. Nothing here is tied to a session."""

from __future__ import annotations

from typing import NamedTuple


class NewEntry(NamedTuple):
    """Something for the directory.

    :param robot_id: the robot it is about, if it is about one
    :param user_id: who registers it
    :param data: a JSON object as text, in ASCII, as :func:`relay_db.base.canonical_json` writes it
    :param ttl: seconds for which it stays without being renewed
    """

    realm: str
    kind: str
    name: str
    address: str
    description: str
    robot_id: int | None
    user_id: int
    data: str
    ttl: float


class EntryRecord(NamedTuple):
    """Something in the directory.

    :param data: as of :class:`NewEntry`
    :param ttl: seconds
    :param registered: Unix seconds
    :param expires: Unix seconds at which it is there no more
    """

    id: str
    realm: str
    kind: str
    name: str
    address: str
    description: str
    robot_id: int | None
    robot: str | None
    user_id: int
    user: str
    data: str
    ttl: float
    registered: float
    expires: float


class EntryCursor(NamedTuple):
    """Where an entry of the directory stands among others: what is about no robot comes first."""

    robot: str
    kind: str
    name: str
    id: str


class EntrySearch(NamedTuple):
    """What is asked of a realm's directory, and what of it may be seen.

    :param robots: robots about which entries are wanted and may be seen; ``None`` for all
    :param general: whether those about no robot are wanted
    :param name: pattern with shell wildcards
    :param after: the place behind which they begin
    """

    realm: str
    robots: frozenset[int] | None = None
    general: bool = True
    kind: str | None = None
    name: str = "*"
    after: EntryCursor | None = None


class LeaseTimes(NamedTuple):
    """How the leases of the directory stand.

    :param there: what there are leases of, also those that are over
    :param soonest: Unix seconds at which the next is over
    :param overlong: whether one lasts longer than it was given: the clock was set back
    """

    there: frozenset[str]
    soonest: float | None
    overlong: bool
