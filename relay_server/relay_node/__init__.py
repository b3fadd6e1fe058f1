"""The relay as a node of every robot's graph: /rosapi/… and /relay/…."""
