"""ImageStreamIO streams: images in shared memory, as used by milk and CACAO."""
