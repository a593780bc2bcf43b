"""Certificates of `lowfc certs`, checked with the standard library's OpenSSL."""

import contextlib
import datetime
import socket
import ssl
import stat
import threading
from pathlib import Path

import pytest
from cryptography import x509

from lowfc.adapters.bus.access import ROUTER
from lowfc.adapters.bus.own_certificate import WARN_DAYS, read_certificate
from lowfc.adapters.bus.routed import certificate_warnings, router_trouble
from lowfc.contract.configuration import Network
from lowfc.contract.errors import ConfigurationError, DataFileError
from tests.support.loops import lowfc, refusal

certificates = pytest.importorskip("lowfc.adapters.bus.certificates", reason="needs the package cryptography")
make, CA_DAYS = certificates.make_certificates, certificates.CA_DAYS


def handshake(server: Path, client: Path, role: str, name: str = "localhost") -> None:
    """Mutual TLS handshake in memory, of a client with a router that it reaches as host `name`.

    Folder `server` has the router's certificate, folder `client` that of the client, whose role is `role`.

    Raises:
        ssl.SSLError: router or client does not accept the other.
    """
    server_context, client_context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    server_context.verify_mode = ssl.CERT_REQUIRED
    server_context.load_verify_locations(server / "ca.pem")
    server_context.load_cert_chain(server / "router.pem", server / "router.key")
    client_context.load_verify_locations(client / "ca.pem")
    client_context.load_cert_chain(client / f"{role}.pem", client / f"{role}.key")
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        server_context.wrap_bio(to_server, to_client, server_side=True),
        client_context.wrap_bio(to_client, to_server, server_hostname=name),
    ]
    for _ in range(10):
        for end in ends:
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
    assert ends[0].getpeercert()["subject"] == ((("commonName", role),),)


def test_router_and_roles_of_one_authority_accept_each_other(tmp_path: Path) -> None:
    certificate_files = make(tmp_path, (ROUTER, "camera", "mirror-dm"), ["localhost", "10.0.0.1"])
    assert [file.name for file in certificate_files] == ["router.pem", "camera.pem", "mirror-dm.pem"]
    for role in ("camera", "mirror-dm"):
        handshake(tmp_path, tmp_path, role)
    handshake(tmp_path, tmp_path, "camera", "10.0.0.1")
    with pytest.raises(ssl.SSLCertVerificationError, match=r"Hostname mismatch|not valid for"):
        handshake(tmp_path, tmp_path, "camera", "example.org")


def test_certificates_of_another_authority_are_rejected(tmp_path: Path) -> None:
    for name in ("ours", "theirs"):
        make(tmp_path / name, (ROUTER, "camera"), ["localhost"])
    with pytest.raises(ssl.SSLCertVerificationError):
        handshake(tmp_path / "theirs", tmp_path / "ours", "camera")
    (tmp_path / "ours" / "ca.pem").write_bytes((tmp_path / "theirs" / "ca.pem").read_bytes())
    with pytest.raises(ssl.SSLError):
        handshake(tmp_path / "theirs", tmp_path / "ours", "camera")


def test_existing_certificates_are_kept_unless_renewed(tmp_path: Path) -> None:
    make(tmp_path, (ROUTER, "camera"), ["localhost"])
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    assert [file.name for file in make(tmp_path, (ROUTER, "camera", "viewer"), [])] == ["viewer.pem"]
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    make(tmp_path, ("camera",), [], renew=True)
    changed = {name for name in before if (tmp_path / name).read_bytes() != before[name]}
    assert changed == {"camera.pem"}  # the key is kept: the new certificate fits the key that the host already has
    handshake(tmp_path, tmp_path, "camera")
    handshake(tmp_path, tmp_path, "viewer")


MISSING_FILES = ((), ("camera.key",), ("camera.pem",), ("camera.key", "camera.pem"))
"""Files that are missing before a renewal. A renewal writes all certificates, but a key only if there is none."""


@pytest.mark.parametrize(
    ("interrupted_at", "missing"),
    [
        (file, missing)
        for file in ("camera.key", "camera.pem", "viewer.pem")
        for missing in MISSING_FILES
        if file[-3:] == "pem" or file in missing
    ],
)
def test_after_an_interruption_each_certificate_fits_its_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interrupted_at: str, missing: tuple[str, ...]
) -> None:
    roles = (ROUTER, "camera", "viewer")
    make(tmp_path, roles, ["localhost"])
    for name in missing:
        (tmp_path / name).unlink()
    replace = Path.replace

    def interrupted(draft: Path, target: Path) -> Path:
        if target.name == interrupted_at:
            raise KeyboardInterrupt
        return replace(draft, target)

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path, roles, ["localhost"], renew=True)
    monkeypatch.undo()
    for role in roles:
        if all((tmp_path / f"{role}.{kind}").exists() for kind in ("pem", "key")):
            handshake(tmp_path, tmp_path, role if role != ROUTER else "viewer")
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    make(tmp_path, roles, [], renew=True)  # the router keeps its address
    handshake(tmp_path, tmp_path, "camera")
    assert stat.S_IMODE((tmp_path / "camera.key").stat().st_mode) == 0o600


def test_a_connection_that_ends_in_the_handshake_is_not_reported_as_a_rejected_certificate(tmp_path: Path) -> None:
    make(tmp_path, (ROUTER, "camera"), ["127.0.0.1"])
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(4096)

        thread = threading.Thread(target=serve)
        thread.start()
        network = Network(router=f"tls/127.0.0.1:{server.getsockname()[1]}", certificates=str(tmp_path))
        assert "was closed during the handshake" in router_trouble(network, "camera")
        thread.join()
    assert "refused" in router_trouble(network, "camera")


def test_the_routers_certificate_is_accepted_under_the_strict_verification_of_python_3_13(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path, (ROUTER, "camera"), ["127.0.0.1"])
    listening, default = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.create_default_context
    listening.load_cert_chain(tmp_path / "router.pem", tmp_path / "router.key")

    def strict(cafile: str) -> ssl.SSLContext:
        context = default(cafile=cafile)
        context.verify_flags |= ssl.VERIFY_X509_STRICT
        return context

    monkeypatch.setattr(ssl, "create_default_context", strict)
    with listening.wrap_socket(socket.create_server(("127.0.0.1", 0)), server_side=True) as server:

        def serve() -> None:
            with contextlib.suppress(ssl.SSLError):  # the client reports a refusal
                server.accept()[0].close()

        thread = threading.Thread(target=serve)
        thread.start()
        network = Network(router=f"tls/127.0.0.1:{server.getsockname()[1]}", certificates=str(tmp_path))
        assert router_trouble(network, "camera") == ""
        thread.join()


def test_a_certificate_is_checked_as_its_peers_check_it(tmp_path: Path) -> None:
    made_at = datetime.datetime.now(datetime.UTC)
    make(tmp_path, (ROUTER, "camera"), ["localhost"], 100)
    for role in (ROUTER, "camera"):
        files = (tmp_path / "ca.pem", tmp_path / f"{role}.pem", tmp_path / f"{role}.key")
        certificate = read_certificate(*files, server=role == ROUTER)
        assert certificate.name == role
        assert abs(certificate.ends - made_at - datetime.timedelta(days=100)) < datetime.timedelta(minutes=10)
        with pytest.raises(DataFileError, match="is not a valid certificate"):
            read_certificate(*files, server=role != ROUTER)
    camera = tmp_path / "camera.pem", tmp_path / "camera.key"
    for unrelated_files in (
        (tmp_path / "ca.pem", camera[0], tmp_path / "router.key"),
        (camera[0], *camera),
        (tmp_path / "none.pem", *camera),
        (camera[1], *camera),
    ):
        with pytest.raises(DataFileError, match=r"camera\.pem is not a valid certificate of .* signed by"):
            read_certificate(*unrelated_files)
    (tmp_path / "own.key").write_text("-----BEGIN ENCRYPTED PRIVATE KEY-----")
    with pytest.raises(DataFileError, match="the key is encrypted"):
        read_certificate(tmp_path / "ca.pem", camera[0], tmp_path / "own.key")


def test_a_certificate_without_a_name_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named = certificates._name
    monkeypatch.setattr(certificates, "_name", lambda name: x509.Name([]) if name == "camera" else named(name))
    make(tmp_path, ("camera",), [])
    with pytest.raises(DataFileError, match="no common name"):
        read_certificate(tmp_path / "ca.pem", tmp_path / "camera.pem", tmp_path / "camera.key")


def test_an_authority_that_did_not_sign_a_certificate_does_not_limit_its_validity(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path, ("camera",), [], 100)
    monkeypatch.setattr(certificates, "CA_DAYS", 10)
    make(tmp_path / "former", ("camera",), [], 100)
    both = tmp_path / "both.pem"
    both.write_bytes((tmp_path / "ca.pem").read_bytes() + (tmp_path / "former" / "ca.pem").read_bytes())
    certificate = read_certificate(both, tmp_path / "camera.pem", tmp_path / "camera.key")
    assert certificate.ends - datetime.datetime.now(datetime.UTC) > datetime.timedelta(days=99)
    assert not certificate.ends_with_authority


def test_certificates_are_warned_about_before_they_expire(tmp_path: Path) -> None:
    now, day = datetime.datetime.now(datetime.UTC), datetime.timedelta(days=1)
    network = Network(router="tls/localhost:7447", certificates=str(tmp_path))
    make(tmp_path, (ROUTER, "camera"), ["localhost"], 100)
    make(tmp_path, ("viewer",), [], CA_DAYS + 100)
    assert certificate_warnings(network, now + (99 - WARN_DAYS) * day) == []
    date = now + 100 * day
    assert certificate_warnings(network, now + (100.5 - WARN_DAYS) * day) == [
        f"{role}'s certificate expires in {WARN_DAYS - 1} days, on {date:%Y-%m-%d}: lowfc certs FOLDER --renew"
        for role in ("camera", "router")
    ]
    warnings = certificate_warnings(network, now + (CA_DAYS - WARN_DAYS + 1) * day)
    assert len(warnings) == 3, "the authority's certificate ends before the viewer's"
    assert warnings[2].endswith("ca.pem expires then: create all of them anew in an empty folder (lowfc certs)")
    (tmp_path / "viewer.key").chmod(0o644)
    (warning,) = certificate_warnings(network, now)
    assert "viewer.key can be read by every user" in warning
    (tmp_path / "viewer.key").chmod(0o640)
    (tmp_path / "camera.key").write_bytes((tmp_path / "viewer.key").read_bytes())
    (warning,) = certificate_warnings(network, now)
    assert "camera.pem is not a valid certificate" in warning


def test_errors_name_the_file_or_option_at_fault(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="by which other hosts reach it"):
        make(tmp_path / "absent", (ROUTER,), [])
    with pytest.raises(ConfigurationError, match=r"without port; got 'host:7447'"):
        make(tmp_path / "absent", (ROUTER,), ["host:7447"])
    with pytest.raises(ConfigurationError, match="absent has no authority whose certificates could be renewed"):
        make(tmp_path / "absent", (ROUTER,), ["host"], renew=True)
    assert not (tmp_path / "absent").exists()
    make(tmp_path / "old", (ROUTER,), ["host", "10.0.0.1"])
    assert make(tmp_path / "old", (ROUTER,), ["10.0.0.1"]) == []
    with pytest.raises(ConfigurationError, match=r"not for host2, 10\.0\.0\.2: renew it"):
        make(tmp_path / "old", (ROUTER,), ["host", "host2", "10.0.0.2"])
    with pytest.raises(DataFileError, match=r"no certificates can be written in .*xxx: File name too long"):
        make(tmp_path / ("x" * 300), ("camera",), [])
    make(tmp_path / "half", ("camera",), [])
    (tmp_path / "half" / "ca.key").unlink()
    with pytest.raises(DataFileError, match=r"has no ca\.key: use the folder that has both ca\.pem and ca\.key"):
        make(tmp_path / "half", ("viewer",), [])
    for name in ("one", "other"):
        make(tmp_path / name, ("camera",), [])
    (tmp_path / "one" / "ca.key").write_bytes((tmp_path / "other" / "ca.key").read_bytes())
    with pytest.raises(DataFileError, match="is not the key of"):
        make(tmp_path / "one", ("viewer",), [])
    (tmp_path / "other" / "camera.key").write_bytes(b"nonsense")
    with pytest.raises(DataFileError, match=r"camera\.key is not a key made by lowfc; remove it"):
        make(tmp_path / "other", ("camera",), [], renew=True)
    (tmp_path / "one" / "ca.key").write_bytes(b"nonsense")
    with pytest.raises(DataFileError, match="are not an authority's key and certificate"):
        make(tmp_path / "one", ("viewer",), [])


def test_nothing_is_signed_by_an_expired_authority(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(certificates, "CA_DAYS", 0)
    with pytest.raises(DataFileError, match=r"ca\.pem expired on .*: make all certificates anew in an empty folder"):
        make(tmp_path, ("camera",), [])
    assert not (tmp_path / "camera.pem").exists()


@pytest.mark.parametrize("name", ["x" * 51, "../x", "Tip", ""])
def test_a_name_that_no_mirror_can_have_is_refused(tmp_path: Path, name: str) -> None:
    assert f"mirror.name = {name!r}" in refusal(
        "certs", tmp_path / "certs", "--router", "localhost", "--mirror", name, kind=ConfigurationError
    )
    assert list(tmp_path.iterdir()) == []


def test_the_command_makes_a_certificate_for_every_role(tmp_path: Path) -> None:
    arguments = ["certs", str(tmp_path / "certs"), "--router", "localhost", "--mirror", "dm", "--mirror", "tip"]
    done = lowfc(*arguments)
    assert done.exit_code == 0, done.output
    roles = {"router", "bench", "camera", "controller", "mirror-dm", "mirror-tip", "operator", "recorder", "viewer"}
    folder = tmp_path / "certs"
    for kind in ("pem", "key"):
        assert {file.stem for file in folder.glob(f"*.{kind}")} == roles | {"ca"}
    assert {stat.S_IMODE(file.stat().st_mode) for file in folder.glob("*.key")} == {0o600}, (
        "keys are readable by their owner only"
    )
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    handshake(folder, folder, "mirror-tip")
    (folder / "mirror-dm.pem").unlink()
    done = lowfc("certs", folder, "--renew", "--router", "localhost")
    assert {Path(file).stem for file in done.stdout.split()} == roles - {"mirror-dm"}
