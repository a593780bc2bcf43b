"""Requirements of a driver on this host: `lowfc doctor --device`."""

from collections.abc import Iterator

from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.device import plugins
from lowfc.programs.commissioning.checks import Check, judged, ok, wrong


def device_checks(name: str, config: Configuration) -> Iterator[Check]:
    """Check each requirement of the camera and mirror driver of this name, without opening the driver."""
    kinds = [kind for kind in plugins.KINDS if name in plugins.installed(kind)]
    for kind in kinds or plugins.KINDS[:1]:
        what = f"{kind} {name}"
        try:
            driver = plugins.load(kind, name)
        except ConfigurationError as fault:
            yield wrong(str(fault), "install it, or correct its name")._replace(name=what)
            continue
        try:
            options = plugins.options(driver, plugins.table(config, kind, name))
        except ConfigurationError as fault:
            advice = f"set it in [drivers.{name}] of a configuration, and give that file with --config FILE"
            yield wrong(str(fault), advice)._replace(name=what)
            continue
        yield ok(f"{driver.__module__}:{driver.__qualname__}")._replace(name=what)
        for need in getattr(driver, "needs", lambda _: ())(options):
            found = need.found
            yield judged(f"{what}: {need.what}", "", bool(found), found or "not found", need.advice)
