"""Check of a role's certificate before a session opens, by a TLS handshake in memory."""

import contextlib
import datetime
from pathlib import Path
from typing import Any, NamedTuple

from lowfc.contract.errors import DataFileError

WARN_DAYS = 60
"""Remaining validity of a certificate, days, below which there is a warning."""

_ROUNDS = 4  # of the handshake; three are needed


class OwnCertificate(NamedTuple):
    """A certificate's common name (its role), and the end of its validity or the authority's, whichever is first.

    `ends_with_authority`: whether the authority's validity ends first, so that renewing the certificate does not help.
    """

    name: str
    ends: datetime.datetime
    ends_with_authority: bool


def read_certificate(authority: Path, certificate: Path, key: Path, *, server: bool = False) -> OwnCertificate:
    """Read a certificate and check that `authority` signed it for `key`; `server`: that it is a server's (router).

    DataFileError if a file cannot be read, the key is encrypted, the three do not match, the certificate or the
    authority is not valid now, or the certificate has no common name. It is not checked that a router's certificate has
    the router's host name.
    """
    import ssl  # slow to import, and only loops on several hosts need it

    try:
        if b"ENCRYPTED" in key.read_bytes():  # ssl would ask for its password on the terminal
            raise ValueError("the key is encrypted, and zenoh needs a plain one")
        listening, connecting = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        connecting.check_hostname = False
        connecting.verify_mode = ssl.CERT_NONE
        verifier = connecting if server else listening
        verifier.load_verify_locations(authority)
        verifier.verify_mode = ssl.CERT_REQUIRED
        for context in (listening, connecting):
            context.load_cert_chain(certificate, key)
        to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
        sides = listening.wrap_bio(to_server, to_client, server_side=True), connecting.wrap_bio(to_client, to_server)
        for side in sides * _ROUNDS:
            with contextlib.suppress(ssl.SSLWantReadError):
                side.do_handshake()
        verifying = sides[1] if server else sides[0]
        fields: Any = verifying.getpeercert() or {}
        name = dict(pair for part in fields["subject"] for pair in part).get("commonName")
        if not name:
            raise ValueError("it has no common name, which must be the role")
        authorities: Any = verifier.get_ca_certs()
        issuers = [issuer for issuer in authorities if issuer["subject"] == fields["issuer"]] or authorities
        last_s = ssl.cert_time_to_seconds(fields["notAfter"])
        authority_last_s = max(ssl.cert_time_to_seconds(issuer["notAfter"]) for issuer in issuers)
    except (OSError, KeyError, ValueError) as fault:  # ssl.SSLError is an OSError
        why = getattr(fault, "verify_message", "") or getattr(fault, "reason", "") or getattr(fault, "strerror", "")
        raise DataFileError(
            f"{certificate} is not a valid certificate of {key} signed by {authority} ({why or fault}): make it where "
            "the authority's key is (lowfc certs FOLDER --renew) and copy it here; is this host's clock right?"
        ) from fault
    ends = datetime.datetime.fromtimestamp(min(last_s, authority_last_s), datetime.UTC)
    return OwnCertificate(name, ends, authority_last_s < last_s)
