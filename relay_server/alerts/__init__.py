"""Alerts: what is wrong with a robot, and how people are notified."""
