"""Clocks, queues, timers, sockets and database access: nothing of the domain."""
