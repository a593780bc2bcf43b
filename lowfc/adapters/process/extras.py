"""How packages that only some commands need are installed, in the way in which lowfc itself was."""

import json
from importlib import metadata
from urllib.parse import unquote, urlsplit

_NAME = "lowfc"


def install_advice(extra: str) -> str:
    """Command line for an extra: from the checkout or the archive that lowfc came from, else from the package index."""
    try:
        found = json.loads(metadata.distribution(_NAME).read_text("direct_url.json") or "{}")
    except metadata.PackageNotFoundError:  # a checkout that is on the path and not installed
        return f"pip install -e '.[{extra}]' in its checkout"
    url = str(found.get("url", ""))
    if not url:
        return f"pip install '{_NAME}[{extra}]'"
    if "vcs_info" in found:
        return f"pip install '{_NAME}[{extra}] @ {found['vcs_info']['vcs']}+{url}'"
    path = unquote(urlsplit(url).path)
    return f"pip install {'-e ' if found.get('dir_info', {}).get('editable') else ''}'{path}[{extra}]'"
