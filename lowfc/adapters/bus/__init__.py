"""The message bus: zenoh, its configuration and access rules, and the runs that it connects."""

DEFAULT_RUN = "default"
"""Run of processes that are started by hand, without naming one."""
