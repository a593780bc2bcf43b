"""A lease: the loop is reserved for one client, and requests of others that would change the loop are refused.

It keeps apart programs that mean well: its identity is in the controller's state, where everybody can read it.

It ends when its holder releases it or does not renew it in time, and by `safe`, `open`, `pause` or `stop` of anybody
else.
"""

from math import ceil
from typing import NamedTuple

from lowfc.control.loop.inputs import COUNT_BITS, Request
from lowfc.control.loop.wording import AUTO

MAX_S = 60.0
MAX_HOLDER = 200
"""Characters of the holder's description."""

ENDED_BY = frozenset({"safe", "open", "pause", "stop"})
"""Requests that are granted to anybody, and that end the lease of somebody else."""
UNRELATED = frozenset({"status", "note", "lease", "renew", "release", "permit"})
"""Requests that do not change the loop, and those of leases themselves."""
LEASE_OVER = "the lease ended: "
"""What the refusal of a renewal begins with; then why."""
OUTLOOK = ", about "
"""What a holder's description ends with that says how long it is going to take."""


class Lease(NamedTuple):
    """A reservation of the loop.

    Attributes:
        id: carried by the holder's requests; above 0.
        holder: the holder and its purpose, for people.
        until_ns: end by the controller's clock, unless it is renewed.
        last_sequence: of the last frame for which it is in force; 0 where the frame rate is not known.
        ended: cause of its end; empty while it is in force.
        holds: it is a permit: a closed loop holds its command while it is in force.
    """

    id: int
    holder: str
    until_ns: int
    last_sequence: int = 0
    ended: str = ""
    holds: bool = False

    @property
    def without_outlook(self) -> str:
        """The holder, without how long it was going to take."""
        return self.holder.rpartition(OUTLOOK)[0] or self.holder

    def over(self, time_ns: int, frame_sequence: int) -> bool:
        """Whether it has not been renewed in time, by the clock or by the frames."""
        same_camera = frame_sequence >> COUNT_BITS == self.last_sequence >> COUNT_BITS
        return time_ns > self.until_ns or (same_camera and 0 < self.last_sequence < frame_sequence)

    def reserved(self, time_ns: int) -> str:
        """The sentence for people."""
        left_s = ceil(max(0, self.until_ns - time_ns) * 1e-9)
        return f"the loop is reserved for {self.holder} (while that runs, and for at most {left_s} s after it)"


def refusal(lease: Lease | None, name: str, lease_id: int, time_ns: int) -> str:
    """Why a request is refused; empty where it is granted.

    Refused are requests of others while a lease is in force, and those of a former holder: whoever ended its lease has
    the last word on the loop. The lease is the last one, in force or ended; `lease_id` is the request's, 0 for
    none; the time is the controller's.
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


def asked_by(held: Lease | None, request: Request) -> str:
    """What a change of the loop is put down to: a request, and what it was for where its sender holds the loop."""
    if request.text.startswith(f"{AUTO}: "):
        return request.text
    if held is not None and request.lease_id and request.lease_id == held.id:
        return f"asked to {request.name} for {held.holder.partition(' by ')[0]}"
    return f"operator asked to {request.name}"
