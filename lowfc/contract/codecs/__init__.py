"""Conversion between messages or files and the values of `lowfc.control`."""
