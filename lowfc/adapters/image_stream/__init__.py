"""ImageStreamIO streams: images in shared memory, as milk and CACAO exchange them."""
