"""What a process uses of its host: clocks, scheduling, service managers, terminals."""
