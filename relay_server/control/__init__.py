"""Who moves a robot: one connection at a time, and everybody may stop it (SPEC section 1.7).

``lease`` is the table of control, ``desk`` keeps it for one robot, ``hub`` has the desks of all. ``orders`` go to the
robot, which answers when they have taken effect; ``stopping`` and ``subsuming`` are what else is ordered. ``record``
keeps who did what.
"""

from relay_server.control import view
from relay_server.control.desk import Desk
from relay_server.control.hub import Desks
from relay_server.control.lease import FREE, Client, Lease, State
from relay_server.control.orders import NotDone
from relay_server.control.record import Actor, DatabaseRecord, Record, reason_in, reason_of
from relay_server.control.stopping import Stopped, StoppedSince
from relay_server.control.terms import ROBOT, Answer, ControlRules, Standing, actor_of, acts_for

__all__ = [
    "FREE",
    "ROBOT",
    "Actor",
    "Answer",
    "Client",
    "ControlRules",
    "DatabaseRecord",
    "Desk",
    "Desks",
    "Lease",
    "NotDone",
    "Record",
    "Standing",
    "State",
    "Stopped",
    "StoppedSince",
    "actor_of",
    "acts_for",
    "reason_in",
    "reason_of",
    "view",
]
