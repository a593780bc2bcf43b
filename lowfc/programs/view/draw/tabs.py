"""The tabs of the layout."""

from enum import StrEnum


class Tab(StrEnum):
    """A tab of the layout."""

    OPERATOR = "operator"
    OPTICS = "optics"
    ENGINEERING = "engineering"
