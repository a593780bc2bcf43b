"""A lease: the loop is reserved for one client, and other clients' requests that would change it are refused.

A lease separates cooperating programs. It is no access control: every client can read its identity in the
controller's state.

A lease ends when its holder releases it or does not renew it in time, on `safe` from any client, and on `open`, `pause`
or `stop` from another client.
"""

from math import ceil
from typing import NamedTuple

from lowfc.control.loop.inputs import COUNT_BITS, Request
from lowfc.control.loop.wording import AUTO

MAX_S = 60.0
"""Longest duration of a lease or permit without renewal, s."""
MAX_HOLDER_LENGTH = 200
"""Largest number of characters of the holder's description."""

ENDED_BY = frozenset({"safe", "open", "pause", "stop"})
"""Requests that no lease refuses; they end another client's lease, and `safe` also ends the client's own."""
UNRELATED = frozenset({"status", "note", "lease", "renew", "release", "permit"})
"""Requests that do not change the loop, and the requests for leases themselves."""
LEASE_OVER = "the lease ended: "
"""Beginning of the refusal of a renewal, before the cause."""
REMAINING_TIME_SEPARATOR = ", about "
"""Separator of the holder and its expected remaining time in the `holder` of a lease."""


class Lease(NamedTuple):
    """A reservation of the loop.

    Attributes:
        id: identity in the holder's requests; above 0.
        holder: the holder and its purpose, for people.
        until_ns: time at which it ends by the controller's clock, unless it is renewed.
        last_sequence: sequence of the last frame for which it is in force, if frames come at the configured rate; 0 if
            the rate is unknown. Before the first frame, the duration of the lease in frames.
        ended: cause of its end; empty while it is in force.
        holds: whether it is a permit: a closed loop holds its command while the permit is in force.
    """

    id: int
    holder: str
    until_ns: int
    last_sequence: int = 0
    ended: str = ""
    holds: bool = False

    @property
    def holder_name(self) -> str:
        """The holder, without its remaining time."""
        return self.holder.rpartition(REMAINING_TIME_SEPARATOR)[0] or self.holder

    def expired(self, time_ns: int, frame_sequence: int) -> bool:
        """Whether the time of the lease is over, by the clock or by the sequence of a frame."""
        return time_ns > self.until_ns or (self.same_start(frame_sequence) and self.last_sequence < frame_sequence)

    def same_start(self, frame_sequence: int) -> bool:
        """Whether `last_sequence` counts from the same start of the camera as this frame's sequence."""
        return self.last_sequence > 0 and frame_sequence >> COUNT_BITS == self.last_sequence >> COUNT_BITS

    def reserved_message(self, time_ns: int) -> str:
        """Message that the loop is reserved, for whom and for how long."""
        remaining_s = ceil(max(0, self.until_ns - time_ns) * 1e-9)
        if self.holds:  # a permit ends even if its holder goes on
            return f"the loop is reserved for {self.holder} (for at most {remaining_s} s more)"
        return f"the loop is reserved for {self.holder} (while that runs, and for at most {remaining_s} s after it)"

    def refused_message(self, time_ns: int) -> str:
        """Message that the loop is reserved, and how to end the reservation in every mode."""
        return f"{self.reserved_message(time_ns)}; `lowfc ctl stop` ends that, `open`, `pause` and `safe` too"


def refusal(lease: Lease | None, name: str, lease_id: int, time_ns: int) -> str:
    """Why a request is refused; empty if it is granted.

    `ENDED_BY` and `UNRELATED` are granted. While a lease is in force, all other requests of other clients are refused;
    after its end those of the former holder, so that it does not act against the client that ended the lease. `lease`
    is the last lease, in force or ended; `lease_id` is the identity in the request, 0 for none; the time is the
    controller's.
    """
    if name in ENDED_BY or name in UNRELATED:
        return ""
    if lease is not None and not lease.ended:
        if lease_id == lease.id:
            return ""
        return lease.refused_message(time_ns)
    if not lease_id:
        return ""
    if lease is None or lease.id != lease_id:
        return "the request's reservation is not in force: did the controller restart?"
    return f"the request's reservation ended: {lease.ended}"


def request_cause(held: Lease | None, request: Request) -> str:
    """Cause of a change of the loop: the request and the purpose of its lease, or the text from automatic gains."""
    if request.text.startswith(f"{AUTO}: "):
        return request.text
    if held is not None and request.lease_id and request.lease_id == held.id:
        return f"asked to {request.name} for {held.holder.partition(' by ')[0]}"
    return f"operator asked to {request.name}"
