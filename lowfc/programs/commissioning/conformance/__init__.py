"""`lowfc conformance`: what a camera or a mirror of somebody else still has to put right."""
