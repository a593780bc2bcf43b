"""A lease: the loop is reserved for one client, and requests of others that would change the loop are refused.

It keeps apart programs that mean well: its identity is in the controller's state, where everybody can read it.

It ends when its holder releases it or does not renew it in time, and by `safe`, `open`, `pause` or `stop` of anybody
else.
"""

from math import ceil
from typing import NamedTuple

from lowfc.control.inputs import COUNT_BITS

MAX_S = 60.0
MAX_HOLDER = 200
"""Characters of the holder's description."""

ENDED_BY = frozenset({"safe", "open", "pause", "stop"})
"""Requests that are granted to anybody, and that end the lease of somebody else."""
UNRELATED = frozenset({"status", "note", "lease", "renew", "release"})
"""Requests that do not change the loop, and those of leases themselves."""


class Lease(NamedTuple):
    """A reservation of the loop.

    Attributes:
        id: carried by the holder's requests; above 0.
        holder: the holder and its purpose, for people.
        until_ns: end by the controller's clock, unless it is renewed.
        last_sequence: of the last frame for which it is in force; 0 where the frame rate is not known.
        ended: cause of its end; empty while it is in force.
    """

    id: int
    holder: str
    until_ns: int
    last_sequence: int = 0
    ended: str = ""

    def over(self, time_ns: int, frame_sequence: int) -> bool:
        """Whether it has not been renewed in time, by the clock or by the frames."""
        same_camera = frame_sequence >> COUNT_BITS == self.last_sequence >> COUNT_BITS
        return time_ns > self.until_ns or (same_camera and 0 < self.last_sequence < frame_sequence)

    def reserved(self, time_ns: int) -> str:
        """The sentence for people."""
        left_s = ceil(max(0, self.until_ns - time_ns) * 1e-9)
        return f"the loop is reserved for {self.holder} (for {left_s} s unless it is renewed)"


def refusal(lease: Lease | None, name: str, lease_id: int, time_ns: int) -> str:
    """Why a request is refused; empty where it is granted.

    Refused are requests of others while a lease is in force, and those of a former holder: whoever ended its lease has
    the last word on the loop.

    Args:
        lease: In force, or the last one that ended; None before the first.
        name: Of the request.
        lease_id: That the request carries; 0 for none.
        time_ns: By the controller's clock.
    """
    if name in ENDED_BY or name in UNRELATED:
        return ""
    if lease is not None and not lease.ended:
        if lease_id == lease.id:
            return ""
        return f"{lease.reserved(time_ns)}; `lowfc ctl open` or `lowfc ctl safe` ends that"
    if not lease_id:
        return ""
    if lease is None or lease.id != lease_id:
        return "the reservation that it is asked under is not in force: did the controller restart?"
    return f"the reservation that it is asked under ended: {lease.ended}"


def extended(lease_id: int, holder: str, values: tuple[float, ...], now: tuple[int, int], rate_hz: float) -> Lease:
    """A lease from now on.

    Args:
        lease_id: Above 0.
        holder: For people, 1 to `MAX_HOLDER` characters.
        values: Its duration in seconds, above 0, at most `MAX_S`.
        now: Time in ns by the controller's clock, and sequence of the newest frame.
        rate_hz: Of the frames; 0 where it is not known.

    Raises:
        ValueError: what is wrong with it.
    """
    duration_s = values[0] if len(values) == 1 else 0.0
    if not 0 < duration_s <= MAX_S:
        raise ValueError(f"a lease takes one duration above 0 and of at most {MAX_S:g} s, got {list(values)}")
    if not lease_id:
        raise ValueError("a lease needs an identity above 0, got 0")
    if not (0 < len(holder) <= MAX_HOLDER and holder.isprintable()):
        raise ValueError(f"a lease names its holder in 1 to {MAX_HOLDER} printable characters, got {holder[:40]!r}")
    time_ns, sequence = now
    last_sequence = sequence + ceil(duration_s * rate_hz) if sequence and rate_hz else 0
    return Lease(lease_id, holder, time_ns + round(duration_s * 1e9), last_sequence)
