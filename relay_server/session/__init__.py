"""One connected client of one robot: what it may, what it listens to, publishes, calls and offers.

``core`` takes each message, judges and hands it to the desk that is concerned: ``listening``, ``publishing``,
``calling``, ``pursuing``, ``providing``. Which one that is, ``operations`` says.
"""

from relay_server.session.core import Session, thin_words
from relay_server.session.ends import ClientTransport, LocalNode, Timing
from relay_server.session.names import normal_type

__all__ = ["ClientTransport", "LocalNode", "Session", "Timing", "normal_type", "thin_words"]
