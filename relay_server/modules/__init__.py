"""Supervised processes of robots: their states, orders to them, their logs, and measurements of all processes."""
