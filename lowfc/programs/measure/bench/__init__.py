"""`lowfc bench`: what recording and the optical model cost on this host."""
