"""The service registry: leased entries of services and applications (SPEC section 1.15)."""
