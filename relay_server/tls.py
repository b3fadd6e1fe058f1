"""TLS of both listeners: 1.2 and newer, certificates reloaded without dropping what is open."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from OpenSSL import SSL
from twisted.internet.interfaces import IOpenSSLServerConnectionCreator
from zope.interface import implementer

from relay_protocol.errors import Invalid


@implementer(IOpenSSLServerConnectionCreator)
class ServerTls:
    """Makes TLS connections for Twisted; its certificate can be read again while it serves.

    :param cert: PEM file with the chain, the relay's own certificate first
    :param key: PEM file with its private key
    :raises Invalid: a file can't be read, or the key is not the certificate's
    """

    def __init__(self, cert: Path, key: Path) -> None:
        self._cert = cert
        self._key = key
        self._context = self._read()

    def serverConnectionForTLS(self, protocol: Any) -> SSL.Connection:
        """A connection with the certificate as it was last read."""
        return SSL.Connection(self._context, None)

    def reload(self) -> None:
        """Read the files again; open connections keep what they have.

        :raises Invalid: as at the start; the old certificate then stays in use
        """
        self._context = self._read()

    def _read(self) -> SSL.Context:
        context = SSL.Context(SSL.TLS_SERVER_METHOD)
        context.set_min_proto_version(SSL.TLS1_2_VERSION)
        context.set_options(SSL.OP_NO_COMPRESSION | SSL.OP_NO_RENEGOTIATION)
        try:
            context.use_certificate_chain_file(str(self._cert))
            context.use_privatekey_file(str(self._key))
            context.check_privatekey()
        except (SSL.Error, OSError):
            raise Invalid(
                f"the TLS certificate {self._cert.name} with the key {self._key.name} can't be used: "
                "both must be readable PEM files that belong together"
            ) from None
        return context
