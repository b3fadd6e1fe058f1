"""One order to many robots (SPEC section 1.11)."""
