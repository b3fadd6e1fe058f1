"""Websockets: handshake, Autobahn adapter, fast path."""
