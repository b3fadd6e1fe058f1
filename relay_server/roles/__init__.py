"""Roles: documents in RDF that say which elements of which platforms work together."""
