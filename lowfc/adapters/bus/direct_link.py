"""The direct link between two processes of the loop on one host: a Unix socket in parallel with the bus.

The bus still carries every message to everybody. The one reader that a topic names (`Topic.direct_subscriber`) gets it
first by a socket in the run's directory: no thread of the bus is between the put and the reader. Messages of a
publisher on another host, or without this library, come by the bus as ever.
"""

import contextlib
import errno
import math
import os
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.envelope import Envelope

Handler = Callable[[Sample], None]

_BUFFER_BYTES = 4 << 20  # some hundred frames, where the host allows it; the kernel allows twice as much
_RETRY_S = 0.1
_LATELY = 1 << 13  # envelopes: more messages than wait in a socket while its reader stands still
_ENVELOPE_BYTES = len(Envelope(0, 0).encode())


class DirectWriter:
    """Sends to the reader, if there is one; never waits."""

    def __init__(self, path: Path) -> None:
        """Send to the process that listens at `path`, now or later."""
        self._path = os.fspath(path)
        self._socket: socket.socket | None = None
        self._again_s = 0.0

    def send(self, envelope: bytes, payload: bytes) -> bool:
        """Send a message, and say whether it went; a reader that is too far behind loses it, as it would on the bus."""
        if self._socket is None:
            self._connect()
            if self._socket is None:
                return False
        try:
            self._socket.sendmsg((envelope, payload))
        except BlockingIOError:
            return False
        except OSError as fault:
            self.close()  # the reader has gone
            if fault.errno == errno.EMSGSIZE:  # more than a socket takes on this host: it will be so with the next
                self._again_s = math.inf
            return False
        return True

    def close(self) -> None:
        """Leave the reader to the bus."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _connect(self) -> None:
        now_s = time.monotonic()
        if now_s < self._again_s:
            return
        self._again_s = now_s + _RETRY_S
        made = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)  # the kernel gives what it allows
            made.connect(self._path)
        except OSError:  # no listener, or not yet
            made.close()
        else:
            self._socket = made


class DirectCall:
    """Sends to a reader of the same process: by a call, which returns once the message is dealt with."""

    def __init__(self, reader: "DirectReader") -> None:
        """Send to it."""
        self._reader = reader

    def send(self, envelope: bytes, payload: bytes) -> bool:
        """Hand a message on; it always goes."""
        self._reader.take(envelope, payload)
        return True

    def close(self) -> None:
        """Leave the reader to the bus."""
        self._reader.writer_gone()


class DirectReader:
    """Forwards each message once, from the socket or the bus, whichever was faster.

    A copy is known by its envelope; numbers alone would not do, for two publishers may have started in the same second.
    The bus is left while a publisher that is alone on its topic uses the socket; a message of it that is still on the
    bus when a newer one has come by the socket is too late, and left out. Where others may publish too, by the bus
    alone, it is never left, and a message that only the bus carried may come after a newer one.
    """

    def __init__(
        self,
        path: Path,
        key: str,
        handler: Handler,
        subscribe: Callable[[Handler], Callable[[], None]],
        now_ns: Callable[[], int],
        failed: Callable[[Exception], None],
        *,
        shared: bool = False,
    ) -> None:
        """Listen, at once.

        Args:
            path: where the writer sends to.
            key: of the topic.
            handler: gets each message, one at a time, on the bus's thread or on one of this reader's own.
            subscribe: to the same topic on the bus; returns what ends that.
            now_ns: the host's clock.
            failed: told of what the handler raises.
            shared: others may publish too.
        """
        self._handler = handler
        self._subscribe = subscribe
        self._now_ns = now_ns
        self._failed = failed
        self._shared = shared
        self._turn = threading.Lock()
        self._key = key
        self._closed = False
        self._lately: dict[tuple[int, int], None] = {}
        self._first = self._newest = -1  # sequences: the first by the socket, and the newest by either way
        self._both = False
        self._leave_bus: Callable[[], None] | None = subscribe(self._by_bus)
        path.unlink(missing_ok=True)  # of a process that was killed: there is one of each role
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(os.fspath(path))
        self._listener.listen(1)
        self._accepting = threading.Thread(target=self._accept, name="direct-link-accept", daemon=True)
        self._accepting.start()

    def take(self, envelope: bytes, payload: bytes) -> None:
        """Hand on a message of a writer, on the thread that calls; of the socket's, or of one in this process."""
        now_ns = self._now_ns()
        try:
            self._by_socket(Sample(self._key, payload, *Envelope.decode_checked(envelope), now_ns))
        except Exception as fault:
            self._failed(fault)
        self._leave()

    def close(self) -> None:
        """Hand on nothing more; for any thread but those that hand on."""
        with self._turn:
            if self._closed:
                return
            self._closed = True
        _end(self._listener)
        self._accepting.join()
        if self._leave_bus is not None:
            self._leave_bus()

    def _by_bus(self, sample: Sample) -> None:
        with self._turn:
            handed = self._hand_on(sample)
            if not handed and not self._shared and 0 <= self._first <= sample.sequence:
                self._both = True  # it has come by both ways: the bus can be left

    def _by_socket(self, sample: Sample) -> None:
        with self._turn:
            if self._first < 0:
                self._first = sample.sequence
            self._hand_on(sample)

    def _hand_on(self, sample: Sample) -> bool:
        """Hand a message on, unless it has come before or is too late."""
        envelope = sample.sequence, sample.publish_time_ns
        late = not self._shared and self._first >= 0 and sample.sequence <= self._newest
        if self._closed or late or envelope in self._lately:
            return False
        self._lately[envelope] = None
        if len(self._lately) > _LATELY:
            del self._lately[next(iter(self._lately))]
        self._newest = sample.sequence
        self._handler(sample)
        return True

    def _leave(self) -> None:
        """After each message of the socket: leave the bus while messages arrive by both paths."""
        if self._both and self._leave_bus is not None:
            self._leave_bus()
            self._leave_bus, self._both = None, False

    def writer_gone(self) -> None:
        """A writer has gone: its messages, or those of the next one, come by the bus."""
        with self._turn:
            self._both, self._first, self._newest = False, -1, -1
        if self._leave_bus is None and not self._closed:
            self._leave_bus = self._subscribe(self._by_bus)

    def _accept(self) -> None:
        """Serve one writer at a time: a new writer replaces the previous one."""
        served: threading.Thread | None = None
        connection: socket.socket | None = None
        with self._listener:
            while True:
                coming = None
                with contextlib.suppress(OSError):
                    coming, _ = self._listener.accept()
                if coming is None and not self._closed:  # out of descriptors, say
                    time.sleep(_RETRY_S)
                    continue
                if served is not None and connection is not None:
                    _end(connection)
                    served.join()
                if coming is None:
                    return
                connection = coming
                served = threading.Thread(target=self._serve, args=(connection,), name="direct-link", daemon=True)
                served.start()

    def _serve(self, connection: socket.socket) -> None:
        with connection:
            self._receive(connection)
        self.writer_gone()

    def _receive(self, connection: socket.socket) -> None:
        buffer = memoryview(bytearray(2 * _BUFFER_BYTES))
        while not self._closed:
            try:
                size = connection.recv_into(buffer)
            except OSError:
                return
            if not size:
                return
            self.take(bytes(buffer[: min(size, _ENVELOPE_BYTES)]), bytes(buffer[_ENVELOPE_BYTES:size]))


def _end(one: socket.socket) -> None:
    """Wake the thread that accepts or receives on the socket."""
    with contextlib.suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)
