"""ROS 2 types: definitions (``.msg`` text), CDR to JSON and back. For the relay; robots handle CDR unread."""
