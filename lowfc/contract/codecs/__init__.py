"""Messages and files to values of the numerics, and back."""
