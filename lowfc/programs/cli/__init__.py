"""The command line, and `lowfc ctl`: what operators ask of a running loop."""
