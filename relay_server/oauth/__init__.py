"""Tokens by OAuth 2.0: service (rules), digest (RFC 7616), http (routes)."""
