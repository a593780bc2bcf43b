"""Drawing on a rerun stream."""
