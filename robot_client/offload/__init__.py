"""Functions that run here or on the relay's workers, for programs on the robot: plain Python, ROS nodes, modules.

::

    from robot_client.offload import cloud, device, offload

    faces = cloud.call("detect_faces", image=jpeg)          # waits for the result
    handle = cloud.submit("analyse_frames", frames=frames)  # does not wait; the result is kept
    if device.critical("cpu"): ...

    @offload("detect_faces")                                # here or there, by the state of the device
    def detect(image: bytes) -> list[Face]: ...
"""

from robot_client.offload.cloud import Cloud, Handle, cloud
from robot_client.offload.decisions import Decision, decisions, offload
from robot_client.offload.device import Device, DeviceState, device

__all__ = ["Cloud", "Decision", "Device", "DeviceState", "Handle", "cloud", "decisions", "device", "offload"]
