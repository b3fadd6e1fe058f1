"""One channel for each robot in use: one link to the robot, shared by all sessions of its clients.

Each part is between a handler of :mod:`relay_server.sessions`, which passes its client as a member (``members``), and
the link to the robot (``link_state``):

- ``publications``: messages of clients to the robot
- ``subscriptions``, ``robot_subscription``, ``client_subscription``: samples of the robot to clients
- ``request_gateway``, ``service_calls``, ``goals``: calls and goals
- ``offered_services``: services and actions that clients offer
- ``robot_requests``: requests to subscribe and to advertise, sent to the robot a few at a time
"""
