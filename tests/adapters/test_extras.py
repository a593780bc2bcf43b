"""How an extra is installed depends on how lowfc was."""

import json
from importlib import metadata

import pytest
import zenoh

from lowfc.adapters.bus.zenoh_fault import plain
from lowfc.adapters.process.extras import install_advice

EDITABLE = {"dir_info": {"editable": True}, "url": "file:///home/a%20b/lowfc"}
WHEEL = {"archive_info": {}, "url": "file:///dist/lowfc-0.2.0-py3-none-any.whl"}
GIT = {"vcs_info": {"vcs": "git", "commit_id": "0"}, "url": "https://example.org/lowfc.git"}


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        (EDITABLE, "pip install -e '/home/a b/lowfc[plots]'"),
        (WHEEL, "pip install '/dist/lowfc-0.2.0-py3-none-any.whl[plots]'"),
        (GIT, "pip install 'lowfc[plots] @ git+https://example.org/lowfc.git'"),
        (None, "pip install 'lowfc[plots]'"),
    ],
)
def test_the_advice_names_where_lowfc_came_from(
    monkeypatch: pytest.MonkeyPatch, origin: dict[str, object] | None, expected: str
) -> None:
    class Installed:
        def read_text(self, name: str) -> str | None:
            assert name == "direct_url.json"
            return None if origin is None else json.dumps(origin)

    monkeypatch.setattr(metadata, "distribution", lambda _: Installed())
    assert install_advice("plots") == expected


def test_a_checkout_that_is_not_installed_has_an_advice_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> metadata.Distribution:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", missing)
    assert install_advice("plots") == "pip install -e '.[plots]' in its checkout"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "Can not create a new TCP listener bound to tcp/127.0.0.1:4: [127.0.0.1:4: Address already in use "
            "(os error 98) at /root/.cargo/git/zenoh/io/tcp.rs:61.] at /root/.cargo/git/zenoh/unicast.rs:338.",
            "127.0.0.1:4: Address already in use (os error 98)",
        ),
        ("invalid configuration at zenoh/src/api/session.rs:12.\nmore", "invalid configuration"),
        ("look at the key", "look at the key"),
    ],
)
def test_the_cause_of_zenohs_fault_is_without_its_sources(text: str, expected: str) -> None:
    assert plain(zenoh.ZError(text)) == expected
