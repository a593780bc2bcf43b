"""How packages that only some commands need are installed."""

import re
import sys
from importlib import metadata


def install_advice(extra: str) -> str:
    """Command line that installs what an extra of lowfc needs, for this interpreter; right wherever lowfc came from."""
    pip = f"{sys.executable or 'python'} -m pip install"
    try:
        needed = metadata.requires("lowfc") or []
    except metadata.PackageNotFoundError:  # a checkout that is on the path and not installed
        return f"{pip} -e '.[{extra}]' in its checkout"
    names = [one.partition(";")[0].strip() for one in needed if re.search(rf"extra == .{extra}.", one)]
    return " ".join([pip, *(f"'{name}'" for name in names)])
