"""The link to the relay: dial, prove identity, reconnect, transport."""
