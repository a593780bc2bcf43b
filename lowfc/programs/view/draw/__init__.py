"""Drawing on a stream of the Rerun viewer."""
