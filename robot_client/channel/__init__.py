"""One channel: the relay's messages become actions on the platform."""
