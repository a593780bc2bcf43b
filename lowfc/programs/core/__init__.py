"""Processes of the controller and the recorder."""
