"""The panels of the view."""
