"""The service registry: leased entries of services and applications (SPEC 1.15)."""
