"""`lowfc design`: masks for a pupil."""
