"""`lowfc record`: the recorder writes every message of a run into a log."""
