"""`python -m lowfc` is the command `lowfc`."""

import signal


def main() -> None:
    """Entry point; while modules load, Ctrl-C ends the process without a traceback."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from lowfc.programs.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
