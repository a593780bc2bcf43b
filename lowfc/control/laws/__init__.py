"""Control laws, their design and their theory."""
