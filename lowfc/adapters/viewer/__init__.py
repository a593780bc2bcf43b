"""The rerun viewer as a child process."""
