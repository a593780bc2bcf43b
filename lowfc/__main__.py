"""`python -m lowfc` is the command `lowfc`."""

import signal


def main() -> None:
    """Entry point; until everything is loaded, Ctrl-C ends it without a word."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from lowfc.programs.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
