"""One channel: carries out the relay's requests on the platform, and sends the platform's samples to the relay."""
