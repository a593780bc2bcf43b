"""Drivers for common interfaces: GenICam cameras and ImageStreamIO streams, loaded through entry points."""
