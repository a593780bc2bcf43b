"""The command line, and `lowfc ctl`: operate a running loop."""
