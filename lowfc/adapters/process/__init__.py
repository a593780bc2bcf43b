"""A process's access to its host: clocks, scheduling, service managers, terminals."""
