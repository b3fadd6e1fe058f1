"""Administration of a realm over HTTP and by the command line (SPEC 1.16)."""
