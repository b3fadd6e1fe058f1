"""The robots' side of the relay: links, registry, mirror of the ROS graph, link quality."""
