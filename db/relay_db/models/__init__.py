"""The tables. Rows hold constraints; rules live in the queries and above.

Times are Unix seconds. Numbers of rows are never given out twice (AUTOINCREMENT on SQLite): an open session
remembers its token by number, and a new token must not inherit it.

No secret is stored: tokens and enrolment codes as SHA-256 in hex, passwords as argon2id, of robot keys the
public half only. Rules of alerts are the exception: what signs a message, or sends one, must be at hand.
"""

from relay_db.models.alerts import Alert, AlertRule
from relay_db.models.columns import LABEL, NAME, SOURCE
from relay_db.models.directory import DirectoryEntry
from relay_db.models.history import AuditEntry, Event, Revision, StoredEvent, StoredEventCount
from relay_db.models.people import (
    AccessToken,
    Group,
    LinkedAccount,
    Membership,
    OAuthClient,
    Realm,
    TokenFamily,
    User,
)
from relay_db.models.robots import (
    EnrolmentCode,
    Right,
    Robot,
    RobotGroup,
    RobotKey,
    RobotMembership,
    RobotRealm,
    StopOrder,
)

__all__ = [
    "LABEL",
    "NAME",
    "SOURCE",
    "AccessToken",
    "Alert",
    "AlertRule",
    "AuditEntry",
    "DirectoryEntry",
    "EnrolmentCode",
    "Event",
    "Group",
    "LinkedAccount",
    "Membership",
    "OAuthClient",
    "Realm",
    "Revision",
    "Right",
    "Robot",
    "RobotGroup",
    "RobotKey",
    "RobotMembership",
    "RobotRealm",
    "StopOrder",
    "StoredEvent",
    "StoredEventCount",
    "TokenFamily",
    "User",
]
