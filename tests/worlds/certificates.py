"""A certificate authority of the tests."""

from __future__ import annotations

import datetime
import ipaddress
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

DAY = datetime.timedelta(days=1)


class Authority:
    """The test's own CA, with its certificate in a file."""

    def __init__(self, folder: Path, name: str) -> None:
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        own = self._sign(self._name, self._key.public_key(), x509.BasicConstraints(True, None), DAY)
        self.path = folder / f"{name}.pem"
        self.path.write_bytes(own.public_bytes(serialization.Encoding.PEM))

    def _sign(
        self, subject: x509.Name, key: Any, extension: x509.ExtensionType, good: datetime.timedelta
    ) -> x509.Certificate:
        now = datetime.datetime.now(datetime.UTC)
        builder = x509.CertificateBuilder().subject_name(subject).issuer_name(self._name).public_key(key)
        builder = builder.serial_number(x509.random_serial_number())
        builder = builder.not_valid_before(now - 2 * DAY).not_valid_after(now + good)
        return builder.add_extension(extension, critical=False).sign(self._key, hashes.SHA256())

    def certify(
        self,
        cert: Path,
        key: Path,
        *,
        host: bool = True,
        name: str = "elsewhere.example",
        good: datetime.timedelta = DAY,
    ) -> int:
        """Writes a server's certificate and key; returns its serial number.

        :param host: for 127.0.0.1 too
        :param name: the server's other name
        :param good: seconds of validity from now on; negative for an expired one
        """
        private = ec.generate_private_key(ec.SECP256R1())
        names: list[x509.GeneralName] = [x509.DNSName(name)]
        if host:
            names.append(x509.IPAddress(ipaddress.ip_address("127.0.0.1")))
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "relay")])
        own = self._sign(subject, private.public_key(), x509.SubjectAlternativeName(names), good)
        cert.write_bytes(own.public_bytes(serialization.Encoding.PEM))
        key.write_bytes(
            private.private_bytes(
                serialization.Encoding.PEM,
                serialization.PrivateFormat.PKCS8,
                serialization.NoEncryption(),
            )
        )
        return own.serial_number
