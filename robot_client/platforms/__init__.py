"""The robot's middleware behind one interface (``base.py``); ``ros2/`` and ``mqtt/`` implement it."""
