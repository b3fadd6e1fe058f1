"""Functions that ship: workers find them as entry points, programs on the robot call them directly."""
