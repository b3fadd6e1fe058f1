"""Administration of a realm over HTTP and by the command line (SPEC section 1.16)."""
