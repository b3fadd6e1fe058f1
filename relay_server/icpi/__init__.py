"""ICPI: programs that are reached, and give commands to Roles, by messages over a websocket."""
