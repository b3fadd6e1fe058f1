"""Events of clients, robots and applications, stored for a while (SPEC 1.14)."""
