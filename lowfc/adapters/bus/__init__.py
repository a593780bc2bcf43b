"""The message bus: zenoh, its configuration and access rules, and the runs whose processes it connects."""

DEFAULT_RUN = "default"
"""Name of the run of processes started without `--run`."""
