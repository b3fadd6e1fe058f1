"""One order to many robots (SPEC section 1.11).

``order`` says what may be asked, ``matching`` which robots are meant; ``errand`` has it done on one robot by a session
that is a client's like any other (``client``), ``rank`` by many side by side; ``desk`` is what edges ask.
"""

from relay_server.fleet.desk import FleetDesk, Plan, local_of
from relay_server.fleet.order import Order, StopOrder
from relay_server.fleet.result import Result

__all__ = ["FleetDesk", "Order", "Plan", "Result", "StopOrder", "local_of"]
