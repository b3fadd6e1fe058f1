"""One order to many robots (SPEC 1.11)."""
