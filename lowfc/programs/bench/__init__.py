"""`lowfc bench`: what recording, a view and the optical model cost on this host."""
