"""Who a client is: passwords, access tokens, tickets, login links, origins."""
