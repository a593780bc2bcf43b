"""`lowfc record`: the recorder, which writes every message of a run into a log."""
