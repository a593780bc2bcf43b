"""The processes of controller and recorder."""
