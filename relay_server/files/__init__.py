"""Files of robots: uploaded by them over a link of their own, listed and downloaded by name."""
