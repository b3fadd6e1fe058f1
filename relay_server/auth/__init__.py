"""Authentication: passwords, access tokens, tickets, login links, origins."""
