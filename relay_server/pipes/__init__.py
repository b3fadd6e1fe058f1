"""Pipes: a topic of one robot is carried to a topic of another, or of the same one."""
