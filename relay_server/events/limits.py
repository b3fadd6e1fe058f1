"""The limits of the event log. Imports nothing of ours."""

DATA = 4096
"""Most characters of an event's data, as JSON in ASCII."""

MAX_PER_REQUEST = 100
"""Events of one request, at most."""

PAGE = 100
MAX_PAGE = 1000
"""Events of an answer: without ``limit``, and at most."""

FIELDS = 8
"""Fields of the data that one query may name."""

TEXT = 255
"""Longest value in a query, in characters."""

BATCH = 500
GATHER_SECONDS = 0.02
"""So many events, or those that come within this time, are written in one transaction."""

QUEUE = 5000
"""Events that wait to be written; requests with more are refused."""

RELAY_QUEUE = 2000
"""Places of this queue that events of the relay may take."""

RETRY_SECONDS = 1.0
"""Pause after a failed write while events of the relay wait."""

RETRY_AFTER_SECONDS = 1.0
"""``Retry-After`` of a request that found the queue full."""

DROP_REPORT_SECONDS = 10.0
"""Shortest time between two reports of dropped events in a realm."""

RECORDED_A_SECOND = 20.0
RECORDED_AT_ONCE = 200
"""Events that the relay stores of one user on one robot: a second in the long run, and at once."""

RATE_KEYS = 10_000
"""Users and robots that are counted for this; the longest quiet are dropped first."""

REALM_EVENTS = 1_000_000
"""Most events of a realm, of all sources together."""

RETENTION_SECONDS = 30 * 86400.0
"""Older events are deleted."""

MAX_READS = 64
MAX_READS_PER_USER = 16
"""Reads that wait for the database: of all users, and of one."""

MAX_SCANS = 2
"""Reads of the database for one page or count; the next page goes on from there."""

MAX_COUNTED_AS_USED = 100
"""A count of at most so many events counts as a use of each."""

MAX_PENDING_USES = 20_000
"""Events with uses that wait to be written; uses of further events are not counted."""

RECENT = 5000
"""Events of a realm in memory for followers."""
