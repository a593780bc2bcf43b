"""Installation advice for packages that only some commands need."""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata

from lowfc.contract.errors import ConfigurationError


def install_advice(extra: str) -> str:
    """Command line that installs the packages of an extra of lowfc for this interpreter."""
    pip = f"{sys.executable or 'python'} -m pip install"
    try:
        required = metadata.requires("lowfc") or []
    except metadata.PackageNotFoundError:  # a checkout on the path that is not installed
        return f"{pip} -e '.[{extra}]' in the checkout of lowfc"
    requirements = [line for line in required if re.search(rf"extra == ['\"]{extra}['\"]", line)]
    names = [line.partition(";")[0].strip() for line in requirements]
    return " ".join([pip, *(f"'{name}'" for name in names)])


@contextmanager
def package_required(what: str, extra: str) -> Iterator[None]:
    """Turn an ImportError in the block into a ConfigurationError with `what`, such as "plots require matplotlib"."""
    try:
        yield
    except ImportError as fault:
        if isinstance(fault.__cause__, KeyboardInterrupt):  # Ctrl-C in the initialisation of a compiled module
            raise fault.__cause__ from None
        raise ConfigurationError(f"{what}, which is missing ({fault}); install: {install_advice(extra)}") from None
