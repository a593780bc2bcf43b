"""`python -m lowfc` is the command `lowfc`."""

import signal
from functools import partial
from importlib import import_module


def main(module: str = "lowfc.programs.cli.main") -> None:
    """Entry point, which runs `main` of `module`; while modules load, Ctrl-C ends the process without a traceback."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    import_module(module).main()


sim_camera, sim_dm = partial(main, "sim_camera.__main__"), partial(main, "sim_dm.__main__")

if __name__ == "__main__":
    main()
