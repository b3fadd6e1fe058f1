"""The vocabulary of the memory: its limits. Imports nothing of ours."""

DATA = 4096
"""Most characters of an event's data, as JSON in ASCII."""

SEVERAL = 100
"""Events of one request, at most."""

PAGE = 100
LONGEST = 1000
"""Events of an answer: of which nobody says how many, and at most."""

FIELDS = 8
"""Fields of the data that one query may name."""

TEXT = 255
"""Longest value in a query, in characters."""

BATCH = 500
GATHER_SECONDS = 0.02
"""So many events, or what comes within this time, are written in one transaction."""

QUEUE = 5000
"""Events that wait to be written; who brings more has to come again."""

OWN_QUEUE = 2000
"""Of these the relay's own fill no more."""

RETRY_SECONDS = 1.0
"""Pause after a write that the database refused, while events of the relay's own wait."""

AGAIN_SECONDS = 1.0
"""When who found the queue full should come again."""

DROPS_SECONDS = 10.0
"""How many of the relay's own were dropped is told no more often in each realm."""

NOTED_A_SECOND = 20.0
NOTED_AT_ONCE = 200
"""What the relay notes of one user on one robot: so many events a second in the long run, and at once."""

NOTED = 10_000
"""Users and robots of which that is counted; the longest quiet are forgotten first."""

SOURCE_EVENTS = 10_000
"""Events that each source may have in a realm."""

REALM_EVENTS = 1_000_000
"""Events that a realm may have, of all sources together."""

KEPT_SECONDS = 30 * 86400.0
"""Older ones go."""

ASKED = 64
ASKED_EACH = 16
"""Queries that wait for the database: of all, and of one user."""

LOOKS = 2
"""Times that the database is asked for one page, or one count; what was not found by then is on the next one."""

COUNTED_USED = 100
"""So many events that were counted, and no more, count as used by that."""

USES = 20_000
"""Events of which uses wait to be written; of more they are not counted."""

RECENT = 5000
"""Events that are kept at hand for who follows them."""
