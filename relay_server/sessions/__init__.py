"""One session for each client of a robot: every message is judged and dispatched to a handler."""
