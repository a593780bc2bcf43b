"""Everything that touches the outside: bus, clock, files, scheduling."""
