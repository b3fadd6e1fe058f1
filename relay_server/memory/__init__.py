"""Short-term memory: what happened of late on a relay, and what programs and people have to remember (SPEC 1.14)."""

from relay_server.memory.asks import DATA_FIELD, Ask, Forms, ask_of
from relay_server.memory.desk import Following, MemoryDesk, NewEvent
from relay_server.memory.house import MemoryHouse
from relay_server.memory.writer import Full

__all__ = [
    "DATA_FIELD",
    "Ask",
    "Following",
    "Forms",
    "Full",
    "MemoryDesk",
    "MemoryHouse",
    "NewEvent",
    "ask_of",
]
