"""Camera and mirror by ImageStreamIO streams, as milk and CACAO use them."""
