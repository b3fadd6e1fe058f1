"""Recordings of topics and cameras in MCAP files."""
