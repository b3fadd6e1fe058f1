"""URLs with a token, by which Foxglove and Lichtblick open one robot."""
