"""A robot's topics, services, actions, parameters, cameras and modules as resources of HTTP (SPEC section 1.13)."""

from relay_server.moments import HEADER, MomentNeeded, Moments, TooOld
from relay_server.resources.cameras import CameraDesk
from relay_server.resources.desk import Asker, ResourceDesk, Wanted
from relay_server.resources.following import Following
from relay_server.resources.forms import NotAcceptable, UnknownForm
from relay_server.resources.goal import Ask, Goal, Owner
from relay_server.resources.goals import GoalDesk, Told
from relay_server.resources.idempotency import (
    KEY_HEADER,
    Idempotency,
    KeyReused,
    Reply,
    Target,
    key_in,
)
from relay_server.resources.listing import Listing, see_known
from relay_server.resources.modules import ModuleDesk
from relay_server.resources.states import NotAsBefore

__all__ = [
    "HEADER",
    "KEY_HEADER",
    "Ask",
    "Asker",
    "CameraDesk",
    "Following",
    "Goal",
    "GoalDesk",
    "Idempotency",
    "KeyReused",
    "Listing",
    "ModuleDesk",
    "MomentNeeded",
    "Moments",
    "NotAcceptable",
    "NotAsBefore",
    "Owner",
    "Reply",
    "ResourceDesk",
    "Target",
    "Told",
    "TooOld",
    "UnknownForm",
    "Wanted",
    "key_in",
    "see_known",
]
