"""lowfc: a real-time low-order wavefront control daemon for coronagraphs."""

__version__ = "0.2.0.dev0"
