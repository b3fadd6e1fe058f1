"""Sessions that the relay opens itself, for HTTP clients and fleet orders."""
