"""`lowfc conformance`: check a camera or mirror driver against the message contract."""
