"""Links to the relay: dial, prove identity, reconnect, decode frames.

``transport`` (bytes), then ``links`` (events), then their owner: ``control_connection`` for the control link,
:mod:`robot_client.channel.channel` for those of channels.
"""
