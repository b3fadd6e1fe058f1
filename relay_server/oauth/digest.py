"""Digest authentication with SHA-256 (RFC 7616): a program proves that it has a secret and does not send it.

Only ``qop=auth`` and only SHA-256: without a count of uses an answer could be sent again, and MD5 is broken.
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
"""How long an answer may use a challenge."""

NONCES = 10_000
"""Challenges in use that are remembered; the longest unused are forgotten, and have to be asked for anew."""

HEADER = 4096
"""Longest header that is read, in characters."""


class StaleNonce(BadCredentials):
    """The answer is right, perhaps, and to an old challenge: try again with the new one."""

    code = "stale_nonce"


class Proof(NamedTuple):
    """What a client answered to a challenge; not checked yet."""

    key: str
    nonce: str
    uri: str
    uses: str
    cnonce: str
    response: str


class Digest:
    """Challenges, and what is answered to them.

    :param seconds: a monotonic clock
    """

    def __init__(self, seconds: Callable[[], float]) -> None:
        self._seconds = seconds
        self._secret = secrets.token_bytes(32)
        self._used: OrderedDict[str, int] = OrderedDict()
        """By challenge, the latest count with which it was answered."""

    def challenge(self, *, stale: bool = False) -> str:
        """The value of ``WWW-Authenticate``.

        :param stale: the last answer was to an old one, and its key need not be asked for again
        """
        again = ", stale=true" if stale else ""
        nonce = self._nonce(self._seconds())
        return f'Digest realm="{REALM}", qop="auth", algorithm=SHA-256, charset=UTF-8, nonce="{nonce}"{again}'

    def read(self, header: str) -> Proof:
        """What the value of ``Authorization`` says.

        :raises BadCredentials: it can't be an answer to a challenge of ours
        """
        try:
            said = Authorization.from_header(header) if len(header) <= HEADER else None
        except ValueError:
            said = None
        if said is None or said.type != "digest":
            raise BadCredentials("the Authorization header can't be read as an answer to a Digest challenge")
        get = said.parameters.get
        if (get("algorithm") or "").upper() != "SHA-256" or get("qop") != "auth" or get("realm") != REALM:
            raise BadCredentials(f'answer with realm="{REALM}", algorithm=SHA-256 and qop=auth')
        names = ("username", "nonce", "uri", "nc", "cnonce", "response")
        values = [get(name) or "" for name in names]
        if not all(values):
            raise BadCredentials(f"an answer to a Digest challenge has {', '.join(names)}")
        return Proof(*values)

    def check(self, proof: Proof, known: str, method: str, uri: str) -> None:
        """Check an answer, and use its count up.

        :param known: the verifier of its key; of an unknown key something that nothing answers
        :param uri: of the request it came with, as it came
        :raises StaleNonce: the challenge is too old, unknown or was answered with this count before
        :raises BadCredentials: it is wrong
        """
        body = ":".join((proof.nonce, proof.uses, proof.cnonce, "auth", _hash(f"{method}:{proof.uri}")))
        said = proof.response.lower().encode("utf-8", "replace")
        right = hmac.compare_digest(_hash(f"{known}:{body}").encode(), said)
        if not right or proof.uri != uri:
            raise BadCredentials("the key is unknown or the secret is wrong")
        if not self._fresh(proof.nonce):
            raise StaleNonce("the challenge is too old; answer the new one")
        self._count(proof)

    def _count(self, proof: Proof) -> None:
        try:
            count = int(proof.uses, 16)
        except ValueError:
            raise BadCredentials(
                "nc is the count of answers to this challenge, eight hexadecimal digits"
            ) from None
        if count <= self._used.get(proof.nonce, 0):
            raise StaleNonce("this answer was given before; answer the new challenge")
        self._used[proof.nonce] = count
        self._used.move_to_end(proof.nonce)
        if len(self._used) > NONCES:
            # Who still counts on it might have his last answer repeated by others: no challenge of before is good now.
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
