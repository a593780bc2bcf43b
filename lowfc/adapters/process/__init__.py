"""What a process needs of its host: clocks, scheduling, service managers, terminals."""
