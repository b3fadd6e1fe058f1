"""The vocabulary of the directory: its limits. Imports nothing of ours."""

KIND = 63
"""Longest kind of an entry, in characters."""

ADDRESS = 1024
"""Longest address, in characters."""

DATA = 2048
"""Most characters of an entry's data, as JSON in ASCII."""

TEXT = 255
"""Longest value in a query, in characters; of a place in the directory:"""

PLACE = 2048

TTL = 60.0
SHORTEST = 2.0
LONGEST = 86_400.0
"""Seconds that a lease lasts of which nobody says how long, at least, and at most."""

OF_USER = 200
OF_REALM = 5000
"""Entries that each user may have, and each realm."""

CHANGES_A_SECOND = 20.0
CHANGES_AT_ONCE = 400
"""Registrations, renewals, changes and removals of one user: in the long run, and at once."""

USERS = 1000
"""Users whose changes are counted; the longest quiet are forgotten first."""

PAGE = 100
MOST = 1000
"""Entries of an answer: of which nobody says how many, and at most."""

LOOKED_AT = 10_000
"""What robots have is looked through so far for one page; the next one goes on there."""

FIRST_LOOK = 20
"""To see what a robot has of a kind counts as much as so many members."""

LOOK_SECONDS = 1.0
"""How often it is seen whether a lease is over; nobody is told of one that is, also before that."""

SURE_SECONDS = 30.0
"""After so long it is seen whatever is known: clocks are set."""

KEPT = 1000
"""Changes of each realm that are kept at hand for who follows them."""
