"""The controller's and the recorder's processes."""
