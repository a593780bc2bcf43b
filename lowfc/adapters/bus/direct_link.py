"""The direct link between two processes of the loop on one host: a Unix socket in parallel with the bus.

The bus still carries every message to all subscribers. A topic's `Topic.direct_subscriber` also receives it through a
socket in the run's directory, without a thread of the bus in between. Messages from another host, or from a program
without this library, arrive over the bus only.
"""

import contextlib
import errno
import math
import mmap
import os
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.envelope import Envelope

Handler = Callable[[Sample], None]

_BUFFER_BYTES = 4 << 20  # for some hundred frames; the kernel cuts it to the host's limit, then doubles it
_RETRY_S = 0.1
_RECENT = 1 << 13  # envelopes remembered; a socket buffers fewer messages (of 200 bytes or more) for a stopped reader
_ENVELOPE_BYTES = len(Envelope(0, 0).encode())


class DirectWriter:
    """Sends to the reader, if connected; never waits."""

    def __init__(self, path: Path) -> None:
        """Set the reader's socket `path`; the reader may start later."""
        self._path = os.fspath(path)
        self._socket: socket.socket | None = None
        self._retry_s = 0.0

    def send(self, envelope: bytes, payload: bytes) -> bool:
        """Send a message and return whether it was sent; a reader too far behind does not receive it."""
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
            if fault.errno == errno.EMSGSIZE:  # larger than this host's socket limit, as later messages will be
                self._retry_s = math.inf
            return False
        return True

    def close(self) -> None:
        """Disconnect; the reader then receives over the bus only."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _connect(self) -> None:
        now_s = time.monotonic()
        if now_s < self._retry_s:
            return
        self._retry_s = now_s + _RETRY_S
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)  # granted up to the host's limit
            connection.connect(self._path)
        except OSError:  # no listener, or not yet
            connection.close()
        else:
            self._socket = connection


class DirectCall:
    """Sends to a reader in the same process by a function call that returns once the message is handled."""

    def __init__(self, reader: "DirectReader") -> None:
        """Set the reader."""
        self._reader = reader

    def send(self, envelope: bytes, payload: bytes) -> bool:
        """Pass a message to the reader; always succeeds."""
        self._reader.take(envelope, payload, self._reader.now_ns())
        return True

    def close(self) -> None:
        """Disconnect; the reader then receives over the bus only."""
        self._reader.writer_gone()


class DirectReader:
    """Forwards each message once, from the socket or the bus, whichever is first.

    A copy is recognised by its envelope; the sequence alone is not enough, as two publishers may have started in the
    same second.

    For a topic with one publisher: once the socket works, a message from the bus is dropped as late unless it is newer
    than all earlier ones. Once a message has arrived on both paths, the reader unsubscribes from the bus, until the
    publisher disconnects from the socket. Messages from the socket are forwarded as they arrive, even if their
    sequences decrease. A message that was new while the reader was unsubscribed is forwarded again if it is repeated.

    For a topic with several publishers: the reader stays subscribed to the bus, and a message that only the bus carried
    may be forwarded after a newer one.
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
        shared: bool,
    ) -> None:
        """Start listening.

        Args:
            path: path of the socket.
            key: key of the topic.
            handler: called with each message, one at a time, on a thread of the bus, of this reader or of a writer.
            subscribe: subscribes a handler to the same topic on the bus; the function it returns unsubscribes.
            now_ns: the host's clock.
            failed: called with the exception if a message from the direct link has an invalid envelope or makes
                `handler` raise; the bus handles the exceptions of its own messages.
            shared: whether the topic has several publishers.
        """
        self._handler = handler
        self._subscribe = subscribe
        self.now_ns = now_ns
        self._failed = failed
        self._shared = shared
        self._lock = threading.Lock()
        self._key = key
        self._closed = False
        self._recent, self._older = set[tuple[int, int]](), set[tuple[int, int]]()
        self._first = self._newest = -1  # sequences: first one from the socket, newest one from either path
        self._on_both_paths = False
        self._unsubscribe: Callable[[], None] | None = lambda: None  # a message may arrive before `subscribe` returns
        self._unsubscribe = subscribe(self._by_bus)
        path.unlink(missing_ok=True)  # left by an earlier process: each role runs only once
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(os.fspath(path))
        self._listener.listen(1)
        self._accepting = threading.Thread(target=self._accept, name="direct-link-accept", daemon=True)
        self._accepting.start()

    def take(self, envelope: bytes, payload: bytes, now_ns: int) -> None:
        """Forward a message received at `now_ns`; called on the socket's thread or that of a writer in this process."""
        try:
            sample = Sample(self._key, payload, *Envelope.decode_checked(envelope), now_ns)
            with self._lock:
                if self._first < 0:
                    self._first = sample.sequence
                # Without the bus, a newer message is no copy. It is not remembered, so a repetition is forwarded.
                surely_new = self._unsubscribe is None and sample.sequence > self._newest
                if surely_new or not self._is_copy(sample):
                    self._forward(sample)
        except Exception as fault:
            self._failed(fault)
        if self._on_both_paths:
            self._leave_bus()

    def close(self) -> None:
        """Stop forwarding, even if a handler never returns; not to be called on a forwarding thread."""
        if self._closed:
            return
        self._closed = True
        _shut_down(self._listener)
        self._accepting.join(1)
        self._on_both_paths = True
        self._leave_bus()

    def _by_bus(self, sample: Sample) -> None:
        with self._lock:
            late = not self._shared and self._first >= 0 and sample.sequence <= self._newest
            if not late and not self._is_copy(sample):
                self._forward(sample)
            elif not self._shared and 0 <= self._first <= sample.sequence:
                self._on_both_paths = True  # received over both paths: the bus can be unsubscribed

    def _is_copy(self, sample: Sample) -> bool:
        """Whether the other path brought this message; if not, remember it."""
        envelope = sample.sequence, sample.publish_time_ns
        if envelope in self._recent or envelope in self._older:
            return True
        self._recent.add(envelope)
        if len(self._recent) == _RECENT:
            self._older, self._recent = self._recent, set()
        return False

    def _forward(self, sample: Sample) -> None:
        if not self._closed:
            if sample.sequence > self._newest:
                self._newest = sample.sequence
            self._handler(sample)

    def _leave_bus(self) -> None:
        """Unsubscribe from the bus; no effect without a subscription."""
        if self._unsubscribe is not None:
            self._unsubscribe()
            self._unsubscribe, self._on_both_paths = None, False

    def writer_gone(self) -> None:
        """Subscribe to the bus again after a writer has disconnected."""
        with self._lock:
            self._on_both_paths, self._first, self._newest = False, -1, -1
        if self._unsubscribe is None and not self._closed:
            self._unsubscribe = self._subscribe(self._by_bus)

    def _accept(self) -> None:
        """Serve one writer at a time: a new writer replaces the previous one."""
        serving: threading.Thread | None = None
        connection: socket.socket | None = None
        with self._listener:
            while True:
                accepted = None
                with contextlib.suppress(OSError):
                    accepted, _ = self._listener.accept()
                if accepted is None and not self._closed:  # accept failed, for example for lack of file descriptors
                    time.sleep(_RETRY_S)
                    continue
                if serving is not None and connection is not None:
                    _shut_down(connection)
                    serving.join()
                if accepted is None:
                    return
                connection = accepted
                serving = threading.Thread(target=self._serve, args=(connection,), name="direct-link", daemon=True)
                serving.start()

    def _serve(self, connection: socket.socket) -> None:
        """Receive from a writer until it disconnects."""
        buffer = memoryview(mmap.mmap(-1, 2 * _BUFFER_BYTES))  # zeroing a bytearray would take 5 ms first
        with connection, contextlib.suppress(OSError):
            while not self._closed:
                size = connection.recv_into(buffer)
                if not size:
                    break
                now_ns = self.now_ns()
                self.take(bytes(buffer[: min(size, _ENVELOPE_BYTES)]), bytes(buffer[_ENVELOPE_BYTES:size]), now_ns)
        self.writer_gone()


def _shut_down(end: socket.socket) -> None:
    """Shut a socket down to wake the thread that accepts or receives on it."""
    with contextlib.suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
