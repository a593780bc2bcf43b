"""`lowfc bench`: the time that recording and the optical model take on this host."""
