"""How packages that only some commands need are installed, in the way in which lowfc itself was."""

import json
import sys
from importlib import metadata
from urllib.parse import unquote, urlsplit

_NAME = "lowfc"


def install_advice(extra: str) -> str:
    """Command line for an extra, for this interpreter: from where lowfc came from, else from the package index."""
    install = f"{sys.executable or 'python'} -m pip install"
    try:
        found = json.loads(metadata.distribution(_NAME).read_text("direct_url.json") or "{}")
    except metadata.PackageNotFoundError:  # a checkout that is on the path and not installed
        return f"{install} -e '.[{extra}]' in its checkout"
    url = str(found.get("url", ""))
    if not url:
        return f"{install} '{_NAME}[{extra}]'"
    if "vcs_info" in found:
        return f"{install} '{_NAME}[{extra}] @ {found['vcs_info']['vcs']}+{url}'"
    path = unquote(urlsplit(url).path)
    return f"{install} {'-e ' if found.get('dir_info', {}).get('editable') else ''}'{path}[{extra}]'"
