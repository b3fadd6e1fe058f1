"""A robot's topics, services, actions, parameters, cameras and nodes as HTTP resources (SPEC 1.13)."""
