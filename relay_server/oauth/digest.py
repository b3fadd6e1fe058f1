"""Digest authentication with SHA-256 (RFC 7616): an OAuth client proves that it has a secret without sending it.

Only ``qop=auth`` and SHA-256 are accepted: without a count of uses an answer could be replayed, and MD5 is
broken.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections import OrderedDict
from collections.abc import Callable
from typing import NamedTuple

from werkzeug.datastructures import Authorization

from relay_server.access import BadCredentials
from relay_server.auth.passwords import REALM

NONCE_SECONDS = 300.0
"""How long a challenge may be answered."""

NONCES = 10_000
"""Challenges in use whose counts are remembered. With more, all challenges become invalid."""

HEADER = 4096
"""Longest header that is parsed, in characters."""


SHOWN = 200
"""Characters of an address that an error shows."""


class StaleNonce(BadCredentials):
    """The answer may be right, but the challenge is too old: answer the new one."""

    code = "stale_nonce"


class WrongAddress(BadCredentials):
    """The answer is right, but was made for another address than the request came to (RFC 7616, section 3.4)."""

    code = "wrong_address"


class Proof(NamedTuple):
    """A client's answer to a challenge, not checked yet.

    :param uses: ``nc``, the count of answers to this challenge, hexadecimal
    """

    key: str
    nonce: str
    uri: str
    uses: str
    cnonce: str
    response: str


class Digest:
    """Makes challenges and checks the answers.

    :param seconds: a monotonic clock
    """

    def __init__(self, seconds: Callable[[], float]) -> None:
        self._seconds = seconds
        self._secret = secrets.token_bytes(32)
        self._used: OrderedDict[str, int] = OrderedDict()
        """By challenge, the highest count with which it was answered."""

    def challenge(self, *, stale: bool = False) -> str:
        """The value of ``WWW-Authenticate``.

        :param stale: only the challenge was too old; the client need not ask for the key again
        """
        again = ", stale=true" if stale else ""
        nonce = self._nonce(self._seconds())
        return f'Digest realm="{REALM}", qop="auth", algorithm=SHA-256, charset=UTF-8, nonce="{nonce}"{again}'

    def read(self, header: str) -> Proof:
        """Parse the value of ``Authorization``.

        :raises BadCredentials: it cannot be an answer to one of our challenges
        """
        try:
            credentials = Authorization.from_header(header) if len(header) <= HEADER else None
        except ValueError:
            credentials = None
        if credentials is None or credentials.type != "digest":
            raise BadCredentials("the Authorization header is not a valid answer to a Digest challenge")
        get = credentials.parameters.get
        if (get("algorithm") or "").upper() != "SHA-256" or get("qop") != "auth" or get("realm") != REALM:
            raise BadCredentials(f'answer with realm="{REALM}", algorithm=SHA-256 and qop=auth')
        proof = Proof(
            key=get("username") or "",
            nonce=get("nonce") or "",
            uri=get("uri") or "",
            uses=get("nc") or "",
            cnonce=get("cnonce") or "",
            response=get("response") or "",
        )
        if not all(proof):
            raise BadCredentials(
                "an answer to a Digest challenge has username, nonce, uri, nc, cnonce, response"
            )
        return proof

    def check(self, proof: Proof, known: str, method: str, uri: str) -> None:
        """Check an answer, and mark its count as used.

        :param known: H(A1) of the key; for an unknown key a value that nothing matches
        :param uri: of the request, as it was sent
        :raises StaleNonce: the challenge is too old or unknown, or was answered with this count before
        :raises WrongAddress: the answer is right for another address
        :raises BadCredentials: the answer is wrong
        """
        body = ":".join((proof.nonce, proof.uses, proof.cnonce, "auth", _hash(f"{method}:{proof.uri}")))
        response = proof.response.lower().encode("utf-8", "replace")
        right = hmac.compare_digest(_hash(f"{known}:{body}").encode(), response)
        if not right:
            raise BadCredentials("the key is unknown or the secret is wrong")
        if proof.uri != uri:
            raise WrongAddress(
                f"the answer is for {proof.uri[:SHOWN]!r}, but the request came to {uri[:SHOWN]!r}; "
                "behind a proxy that changes addresses, send key and secret by Basic over TLS"
            )
        if not self._fresh(proof.nonce):
            raise StaleNonce("the challenge is too old; answer the new one")
        self._count(proof)

    def _count(self, proof: Proof) -> None:
        try:
            count = int(proof.uses, 16)
        except ValueError:
            raise BadCredentials(
                "nc must be the count of answers to this challenge, as hexadecimal digits"
            ) from None
        if count <= self._used.get(proof.nonce, 0):
            raise StaleNonce("this answer was used before; answer the new challenge")
        self._used[proof.nonce] = count
        self._used.move_to_end(proof.nonce)
        if len(self._used) > NONCES:
            # Without its count the last answer to a challenge could be replayed, so all challenges become
            # invalid.
            self._secret = secrets.token_bytes(32)
            self._used.clear()

    def _nonce(self, now: float) -> str:
        made = f"{now:.3f}.{secrets.token_hex(8)}"
        return f"{made}.{self._seal(made)}"

    def _fresh(self, nonce: str) -> bool:
        made, _, seal = nonce.rpartition(".")
        if not hmac.compare_digest(self._seal(made).encode(), seal.encode("utf-8", "replace")):
            return False
        return self._seconds() - float(made.rpartition(".")[0]) <= NONCE_SECONDS

    def _seal(self, made: str) -> str:
        return hmac.new(self._secret, made.encode("utf-8", "replace"), hashlib.sha256).hexdigest()


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "replace")).hexdigest()
