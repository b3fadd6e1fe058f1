"""The demo: one relay, or three of a cluster, with simulated robots, and a simulated home if wanted."""
