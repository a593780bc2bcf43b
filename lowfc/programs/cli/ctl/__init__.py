"""`lowfc ctl`: what operators ask of a running loop."""
