"""Files that the robot uploads to the relay: groups of them are watched, sent, and deleted once confirmed."""
