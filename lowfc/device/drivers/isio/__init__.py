"""Camera and mirror drivers for ImageStreamIO streams, as in milk and CACAO."""
