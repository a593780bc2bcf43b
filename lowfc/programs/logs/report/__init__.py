"""The report of a run: figures from its log, and the page that shows them."""
