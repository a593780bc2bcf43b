"""The report of a run: results from its log, and the page that shows them."""
