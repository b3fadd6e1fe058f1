"""Events of clients, robots and applications, stored for a while (SPEC section 1.14)."""
