"""Tokens for programs and people by OAuth 2.0: what is issued, to whom, for how long, and what is left of it.

``desk`` decides; ``digest`` proves programs by key and secret without sending the secret. The addresses are in
``edges/oauth.py``.
"""

from relay_server.oauth.desk import OAuthDesk
from relay_server.oauth.digest import Digest, Proof, StaleNonce
from relay_server.oauth.terms import Granted, OAuthError, TokenAsk

__all__ = ["Digest", "Granted", "OAuthDesk", "OAuthError", "Proof", "StaleNonce", "TokenAsk"]
