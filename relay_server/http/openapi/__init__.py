"""The HTTP API described, from what stands at its routes."""
