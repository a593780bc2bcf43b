"""Certificates: the bench's own authority, and one certificate per role, with the role as common name.

The authority's folder holds the signing key ca.key, which must not be on any host of the loop. A host gets ca.pem, and
ROLE.pem and ROLE.key of each of its roles.
"""

import contextlib
import datetime
import ipaddress
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, EllipticCurvePrivateKey, generate_private_key
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from lowfc.adapters.bus.access import ROUTER
from lowfc.adapters.bus.routed import CA, CA_KEY
from lowfc.adapters.files.whole_file import write_whole
from lowfc.contract.errors import ConfigurationError, DataFileError

CA_DAYS, DAYS = 3650, 825
"""Validity of the authority's certificate, and default validity of a role's certificate, days."""

_BACKDATED = datetime.timedelta(hours=1)  # a certificate is valid from an hour ago, because hosts' clocks differ


def make_certificates(
    folder: Path, roles: Iterable[str], addresses: Sequence[str], days: int = DAYS, *, renew: bool = False
) -> list[Path]:
    """Make the authority and the certificates that do not exist yet.

    Args:
        folder: folder of the authority; created with access for this user only.
        roles: roles to make certificates for, including the router's.
        addresses: names and IP addresses by which others reach the router; if empty, `renew` keeps the present ones.
        days: validity of the certificates, days.
        renew: also renew existing certificates, with their present keys; the authority is never renewed.

    Returns:
        Files of the roles' new certificates.

    Raises:
        ConfigurationError: an address is missing, invalid, or not in the router's certificate; `renew` finds no
            authority.
        DataFileError: the authority's key or certificate is missing, or its certificate has expired; a file is not the
            key or certificate that its name says; the folder cannot be written.
    """
    names = [_general_name(address) for address in addresses]
    try:
        to_make = [role for role in roles if renew or not (folder / f"{role}.pem").exists()]
        if renew and not names and (folder / f"{ROUTER}.pem").exists():
            names = _router_addresses(folder)
        if ROUTER in to_make and not names:
            raise ConfigurationError(
                "the router's certificate needs the router's address: give with --router the name by which other "
                "hosts reach it"
            )
        if renew and not (folder / CA).exists():
            raise ConfigurationError(f"{folder} has no authority whose certificates could be renewed")
        if ROUTER not in to_make and (uncovered := [n.value for n in names if n not in _router_addresses(folder)]):
            raise ConfigurationError(
                f"the router's certificate is not for {', '.join(map(str, uncovered))}: renew it "
                "(--renew), with --router for each of its addresses"
            )
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        key, authority = _authority(folder)
        for role in to_make:
            role_key = _role_key(folder, role)
            usage = ExtendedKeyUsageOID.SERVER_AUTH if role == ROUTER else ExtendedKeyUsageOID.CLIENT_AUTH
            builder = _builder(role, role_key, days).issuer_name(authority.subject)
            builder = builder.add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
            if role == ROUTER:
                builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
            write_whole(folder / f"{role}.pem", builder.sign(key, SHA256()).public_bytes(Encoding.PEM))
    except OSError as fault:
        raise DataFileError(f"no certificates can be written in {folder}: {fault.strerror or fault}") from fault
    return [folder / f"{role}.pem" for role in to_make]


def _authority(folder: Path) -> tuple[EllipticCurvePrivateKey, x509.Certificate]:
    """Key and certificate of the authority; both are made if neither exists."""
    certificate_file, key_file = folder / CA, folder / CA_KEY
    missing = [file.name for file in (certificate_file, key_file) if not file.exists()]
    if len(missing) == 2:
        new_key = generate_private_key(SECP256R1())
        builder = _builder("lowfc authority", new_key, CA_DAYS, authority=True).issuer_name(_name("lowfc authority"))
        write_whole(key_file, _pem(new_key), mode=0o600)
        write_whole(certificate_file, builder.sign(new_key, SHA256()).public_bytes(Encoding.PEM))
    elif missing:
        raise DataFileError(
            f"{folder} has no {missing[0]}: use the folder that has both {CA} and {CA_KEY}, or make all "
            "certificates anew in an empty folder"
        )
    try:
        key = load_pem_private_key(key_file.read_bytes(), password=None)
        certificate = x509.load_pem_x509_certificate(certificate_file.read_bytes())
    except (ValueError, TypeError) as fault:
        raise DataFileError(f"{key_file} and {certificate_file} are not an authority's key and certificate") from fault
    if not isinstance(key, EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise DataFileError(
            f"{key_file} is not the key of {certificate_file}; make all certificates anew in an empty folder"
        )
    if (expiry := certificate.not_valid_after_utc) <= datetime.datetime.now(datetime.UTC):
        raise DataFileError(
            f"{certificate_file} expired on {expiry:%Y-%m-%d}: make all certificates anew in an empty folder"
        )
    return key, certificate


def _router_addresses(folder: Path) -> list[x509.GeneralName]:
    """Addresses of the router's present certificate."""
    file = folder / f"{ROUTER}.pem"
    with contextlib.suppress(ValueError, x509.ExtensionNotFound):
        extensions = x509.load_pem_x509_certificate(file.read_bytes()).extensions
        return list(extensions.get_extension_for_class(x509.SubjectAlternativeName).value)
    raise DataFileError(f"{file} is not a router's certificate; remove it to have a new one made")


def _role_key(folder: Path, role: str) -> EllipticCurvePrivateKey:
    """A role's key; a missing key is made before the certificate, so that an interruption leaves no mismatched pair."""
    file = folder / f"{role}.key"
    if not file.exists():
        (folder / f"{role}.pem").unlink(missing_ok=True)  # the certificate of a lost key
        new_key = generate_private_key(SECP256R1())
        write_whole(file, _pem(new_key), mode=0o600)
        return new_key
    with contextlib.suppress(ValueError, TypeError):
        stored = load_pem_private_key(file.read_bytes(), password=None)
        if isinstance(stored, EllipticCurvePrivateKey):
            return stored
    raise DataFileError(f"{file} is not a key made by lowfc; remove it to have a new one made")


def _builder(name: str, key: EllipticCurvePrivateKey, days: int, *, authority: bool = False) -> x509.CertificateBuilder:
    """Certificate builder for a key, without issuer and extended key usage."""
    now = datetime.datetime.now(datetime.UTC)
    usage = x509.KeyUsage(
        digital_signature=not authority,
        key_cert_sign=authority,
        crl_sign=authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
    return (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=authority, path_length=0 if authority else None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _general_name(address: str) -> x509.GeneralName:
    with contextlib.suppress(ValueError):
        return x509.IPAddress(ipaddress.ip_address(address))
    if not re.fullmatch(r"[A-Za-z0-9.-]+", address):
        raise ConfigurationError(f"the router's address is a host name or an IP address, without port; got {address!r}")
    return x509.DNSName(address)


def _pem(key: EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
