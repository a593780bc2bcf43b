"""Settings that grant a user real-time rights (files, a group, access to a device): show, apply, undo."""

import os
import shutil
import subprocess
from pathlib import Path

from lowfc.contract.errors import ConfigurationError

GROUP = "lowfc"
DEVICE = "dev/cpu_dma_latency"
_LIMITS = f"@{GROUP}  -  rtprio   98\n@{GROUP}  -  memlock  unlimited\n"
_RULE = f"""# The loop's processes disable CPU idle states (realtime.disable_cpu_idle).
SUBSYSTEM=="misc", KERNEL=="cpu_dma_latency", GROUP="{GROUP}", MODE="0660"
"""
FILES = {"etc/security/limits.d/90-lowfc.conf": _LIMITS, "etc/udev/rules.d/90-lowfc-user.rules": _RULE}
"""Contents by path below the root. The files of `deploy` have other names, so that --undo leaves them in place."""


def settings_text(root: Path) -> str:
    """Text of the files to write, and of the commands that root has to run."""
    files = [f"# {root / name}\n{text}" for name, text in FILES.items()]
    user = os.environ.get("SUDO_USER") or os.environ.get("USER", "NAME")
    commands = f"groupadd --system --force {GROUP}\nusermod -aG {GROUP} {user}\n"
    device = root / DEVICE
    return "\n".join([*files, f"# as root\n{commands}chgrp {GROUP} {device}\nchmod 660 {device}"])


def apply(root: Path, user: str) -> list[str]:
    """Write the files, create the group with this user, and give the group access to the device; return what was done.

    Raises:
        ConfigurationError: not root, or a file exists with other contents.
        OSError: a file cannot be written, or a command failed.
        LookupError: the group was not created.
    """
    _require_root("--apply")
    for name, text in FILES.items():
        file = root / name
        if file.exists() and file.read_bytes() != text.encode():
            raise ConfigurationError(
                f"{file} exists with other contents: move it away, or add the lines of --setup to it by hand"
            )
    done = []
    for name, text in FILES.items():
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
        done.append(f"wrote {file}")
    done.append(_run("groupadd", "--prefix", str(root), "--system", "--force", GROUP))
    if (root / DEVICE).exists():
        shutil.chown(root / DEVICE, group=GROUP)
        (root / DEVICE).chmod(0o660)
        done.append(f"{root / DEVICE} is accessible to the group {GROUP}")
    if user:
        done.append(_run("usermod", "--prefix", str(root), "--append", "--groups", GROUP, user))
    return [*done, f"effective for {user or 'members of the group ' + GROUP} from the next login"]


def undo(root: Path) -> list[str]:
    """Remove the files if unchanged, the group, and its access to the device; return what was done.

    Raises:
        ConfigurationError: not root.
        OSError: a file cannot be removed, or the device cannot be changed.
    """
    _require_root("--undo")
    done = []
    for name, text in FILES.items():
        file = root / name
        if file.exists() and file.read_bytes() == text.encode():
            file.unlink()
            done.append(f"removed {file}")
    if (root / DEVICE).exists():
        shutil.chown(root / DEVICE, group=0)
        (root / DEVICE).chmod(0o600)
        done.append(f"{root / DEVICE} is accessible to root only")
    try:
        return [*done, _run("groupdel", "--prefix", str(root), GROUP)]
    except OSError as fault:  # there is no such group, or it is the primary group of the services' user
        return [*done, str(fault)]


def _require_root(option: str) -> None:
    if os.geteuid() != 0:
        raise ConfigurationError(f"lowfc doctor {option} changes the host and needs root; --setup shows the settings")


def _run(name: str, *arguments: str) -> str:
    """Run a command of the host; return its command line. OSError if it does not exist or fails."""
    program = shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin") or name
    run = subprocess.run([program, *arguments], capture_output=True, text=True, check=False)  # noqa: S603  # as shown
    command_line = " ".join((name, *arguments))
    if run.returncode:
        raise OSError(f"{command_line}: {run.stderr.strip()}")
    return command_line
