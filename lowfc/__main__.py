"""`python -m lowfc` is the command `lowfc`."""

from lowfc.programs.cli import main

main()
