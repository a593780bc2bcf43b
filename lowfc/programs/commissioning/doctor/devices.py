"""Requirements of a driver on this host: `lowfc doctor --device`."""

from collections.abc import Iterator

from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.device import Need, plugins
from lowfc.device.watch import opening
from lowfc.programs.commissioning.checks import Check, judged, ok, wrong


def device_checks(name: str, config: Configuration) -> Iterator[Check]:
    """Check each requirement of the camera and mirror drivers of this name, without opening them."""
    kinds = _kinds(name)
    for kind in kinds:
        label = f"{kind} {name}"
        try:
            driver = plugins.load(kind, name)
        except ConfigurationError as fault:
            yield wrong(str(fault), "install it, or correct its name")._replace(name=label)
            continue
        try:
            options = plugins.options(driver, plugins.table(config, kind, name))
        except ConfigurationError as fault:
            section = f"drivers.{plugins.section(name)}" + (f".{kind}" if len(kinds) > 1 else "")
            advice = f"set it in [{section}] of a configuration, and give that file with --config FILE"
            yield wrong(str(fault), advice)._replace(name=label)
            continue
        found = getattr(driver, "__qualname__", type(driver).__qualname__)  # a factory such as `partial` has none
        yield ok(f"{driver.__module__}:{found}")._replace(name=label)
        try:
            with opening("its requirements cannot be checked"):
                needs = getattr(driver, "needs", lambda _: ())(options)
                needs = [Need(*(str(part or "") for part in need)) for need in needs]  # found may be a path, or None
        except ConfigurationError as fault:
            yield wrong(str(fault), "correct its method `needs`, or the code it calls")._replace(name=label)
            continue
        for need in needs:
            yield judged(f"{label}: {need.what}", "", bool(need.found), need.found or "not found", need.advice)


def _kinds(name: str) -> list[plugins.Kind]:
    """Kinds (camera, mirror) of the installed drivers of this name, or else of a driver class of this name.

    If there is neither, it is the first kind: loading this driver then gives the error.
    """
    found = [kind for kind in plugins.KINDS if name in plugins.installed(kind)]
    return found or [kind for kind in plugins.KINDS if _loads(kind, name)] or list(plugins.KINDS[:1])


def _loads(kind: plugins.Kind, name: str) -> bool:
    try:
        plugins.load(kind, name)
    except ConfigurationError:
        return False
    return True
