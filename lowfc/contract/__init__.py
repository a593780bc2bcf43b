"""What the processes agree on: messages, topics, configuration, errors and events."""
