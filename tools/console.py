"""Make the pictures of docs/howto/console.md: `python -m tools.measure console`, about two minutes.

Real processes are brought into each state, and a console without a terminal draws the picture.
"""

import asyncio
import sys
from collections.abc import Callable

from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.messages import Role
from tools.pictures import BRIGHT, PICTURES, SMALL_WELL, PictureRun, picture_run

SLOW = {"camera.rate_hz": 100.0}
"""At this rate the pictures do not need a quiet host."""
LOOK_S = 6.0
"""Wait before the change of state, and again between its display and the picture."""
DISPLAY_TIMEOUT_S = 60


def picture(run: PictureRun, name: str, word: str, change_state: Callable[[], object]) -> None:
    """Change the state of a run, wait until the console shows `word`, and store the picture."""
    from lowfc.programs.console.app import Console

    async def take_picture() -> None:
        app = Console(bus, run.run.run_id, HostClock())
        async with app.run_test(size=(100, 30)) as pilot:
            await pilot.pause(LOOK_S)
            await asyncio.to_thread(change_state)
            for _ in range(DISPLAY_TIMEOUT_S):
                await pilot.pause(1.0)
                if any(word in str(app.query_one(where).render()) for where in ("#verdict", "#tiles")):
                    break
            else:
                raise SystemExit(f"the console did not show {word!r} within {DISPLAY_TIMEOUT_S} s")
            await pilot.pause(LOOK_S)
            shown = app.export_screenshot(title=f"lowfc console, {name.replace('-', ' ')}")
            (PICTURES / f"console-{name}.svg").write_text(shown)

    bus = ZenohBus(run.run.links, Role.OPERATOR, HostClock(), monitor=True)
    try:
        asyncio.run(take_picture())
    finally:
        bus.close()
    sys.stderr.write(f"{name}\n")


def make() -> None:
    """Take the pictures of every state."""
    with picture_run(BRIGHT | SLOW) as run:
        loop = run.client()
        picture(run, "healthy", "CLOSED", lambda: loop.note("HD 209458, seeing 0.8 arcsec"))
        picture(run, "open", "OPEN", loop.open_loop)
        loop.close_loop()
        picture(run, "star-gone", "GONE", lambda: run.restart_camera(BRIGHT | SLOW | {"star.magnitude": 9.0}))
    with picture_run(SMALL_WELL | SLOW) as run:
        picture(run, "saturated", "SATURATED", lambda: run.restart_camera(SMALL_WELL | SLOW | {"star.magnitude": -2.0}))
    with picture_run(BRIGHT | SLOW) as run:
        picture(run, "camera-dead", "NO FRAMES", lambda: run.kill(Role.CAMERA))
        picture(run, "not-connected", "NOT CONNECTED", lambda: kill_all(run))


def kill_all(run: PictureRun) -> None:
    """Kill the remaining processes of a run whose camera is dead."""
    for name in (Role.CONTROLLER, run.mirror, Role.RECORDER):
        run.kill(name)
