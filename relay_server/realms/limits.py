"""The vocabulary of administration over HTTP: its limits. Imports nothing of ours."""

CHANGES_A_SECOND = 2.0
CHANGES_AT_ONCE = 200
"""Changes of one realm: in the long run, and at once. After each the whole relay looks at the database."""

PATTERNS_A_CHANGE = 8
"""So many patterns of a right count as one more change: they are compiled where robots are served."""

PASSWORDS_AT_ONCE = 16
"""New passwords that are hashed or wait for it; people who log in wait in the same line."""

REALMS = 1000
"""Realms whose changes are counted; the longest quiet are forgotten first."""

NAME_SENT = 255
"""Characters in which a name may be sent; its one form is shorter."""

PATTERN_SENT = 255
"""Characters in which a pattern may be sent."""

SCOPE_SENT = 4096
"""Characters in which the scope of a program may be sent."""

MOST = {
    "users": 5000,
    "groups": 1000,
    "robots": 1000,
    "memberships": 20_000,
    "rights": 20_000,
    "programs": 5000,
    "robot_groups": 1000,
    "robot_memberships": 20_000,
}
"""What a realm may come to have over HTTP; the command line has no such limit."""

MOST_PATTERNS = 2000
MOST_PATTERNS_OF_A_ROBOT = 256
"""Patterns of all rights in a realm, and of those on one robot: likewise."""
