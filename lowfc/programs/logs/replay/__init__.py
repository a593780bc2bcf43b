"""`lowfc replay`: a log folded through the live loop again, and everything compared."""
