"""Independent readers of MCAP: Foxglove's (node) and rerun's."""

import json
import os
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

NODE = Path(__file__).parents[1] / "node"


def foxglove(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """Content of each finished log according to @mcap/core, with checksums checked."""
    if shutil.which("node") is None or not (NODE / "node_modules").is_dir():
        pytest.skip("node or its packages are missing: make node")
    command = ["node", "count.mjs", *map(str, paths)]
    done = subprocess.run(command, cwd=NODE, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def rerun(subcommand: str, path: Path) -> str:
    """Output of `rerun mcap info` or `rerun mcap check` for a log."""
    import rerun_cli

    binary = str(Path(rerun_cli.__file__).parent / "rerun")
    folder = str(path.parent)
    home = os.environ | {"HOME": folder, "XDG_CONFIG_HOME": folder, "XDG_DATA_HOME": folder}
    done = subprocess.run(
        [binary, "mcap", subcommand, path], env=home, capture_output=True, text=True, timeout=20, check=False
    )
    assert done.returncode == 0, f"{path.name}: {done.stderr}"
    return done.stdout
