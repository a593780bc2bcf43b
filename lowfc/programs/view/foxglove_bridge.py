"""The bus as a Foxglove WebSocket server, for Foxglove and Lichtblick.

Payloads are passed on unchanged; the schemas are those of the log. A channel hands its message to the server's threads
and returns at once, so the bus's threads call the channel's `log` directly. A client that does not read loses its
oldest messages: at most 1024 wait for it.
"""

import contextlib
import logging
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from lowfc.adapters.bus.bus import ALL, Bus, Sample, last_messages
from lowfc.adapters.bus.names import Names
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.logs.writer import declaration
from lowfc.adapters.process.clock import Clock
from lowfc.adapters.process.extras import package_required
from lowfc.adapters.process.service import Service
from lowfc.contract.errors import BadMessageError, BusError
from lowfc.contract.messages import TOPICS, Role, Topic

if TYPE_CHECKING:
    from foxglove import Channel
    from foxglove.websocket import ChannelView, Client

HOST = "127.0.0.1"
DEFAULT_PORT = 8765
"""Default port of Foxglove and Lichtblick."""
SHOWN = tuple(topic for topic in TOPICS if Role.VIEWER in topic.subscribers)
"""Topics to which a viewer subscribes."""

_POLL_S = 0.05
_QUERY_TIMEOUT_S = 0.2


class FoxgloveBridge:
    """Passes the messages of a bus to the applications that connect to `port` on loopback.

    `subscriptions`: client and topic of each current subscription; `last_states`: the states in force by key.
    """

    def __init__(self, bus: Bus, clock: Clock, run_id: str, port: int) -> None:
        """Serve at `port`, or at a free one if it is 0, and subscribe.

        Raises:
            BusError: the port is in use.
            ConfigurationError: foxglove-sdk is not installed.
        """
        with package_required("--foxglove requires foxglove-sdk", "foxglove"):
            import foxglove
        logging.getLogger("foxglove").setLevel(logging.CRITICAL)  # a client that disconnects is not an error
        self._foxglove: Any = foxglove
        self._context = self._foxglove.Context()
        self._clock, self._run_id = clock, run_id
        self._channels: dict[str, Channel] = {}
        self._channels_lock = threading.Lock()
        self.last_states: dict[str, Sample] = {}
        self.subscriptions: set[tuple[int, str]] = set()
        self._messages = 0
        for topic in SHOWN:
            if topic.key == topic.at(ALL):  # other keys contain names that are not known yet
                self._channel(topic, topic.key)
        try:
            self._server = self._foxglove.start_server(
                name=f"lowfc {run_id}", host=HOST, port=port, server_listener=self, context=self._context
            )
        except RuntimeError as fault:
            raise BusError(
                f"cannot listen on {HOST}:{port} ({fault}); stop the program that uses it, or use another --port"
            ) from None
        self.port: int = self._server.port
        self.join(bus)

    def join(self, bus: Bus) -> None:
        """Subscribe on the bus of a run; the bus of an earlier run of the same name is already closed."""
        self._bus, self._names = bus, Names()
        self.last_states.clear()
        # The service subscribes to Health last: once the viewer reports Health of a peer, that peer assumes that all
        # subscriptions of the viewer are in place.
        for topic in SHOWN:
            bus.subscribe(topic, partial(self._publish, topic))
        self.service = Service(Role.VIEWER, self._run_id, self._clock, bus)

    def run(self, restarted: Callable[[], bool] = lambda: False) -> None:
        """Serve until stopped, or until `restarted` returns True."""
        self.service.state = "running"
        while self.service.running and not restarted():
            if self.service.has_newcomers():
                for topic, sample in last_messages(self._bus, SHOWN, _QUERY_TIMEOUT_S):  # published before joining
                    last = self.last_states.get(sample.key)
                    if last is None or last.sequence < sample.sequence:
                        try:
                            self._publish(topic, sample)
                        except BadMessageError as error:
                            self.service.unreadable(sample.key, error)
            self.service.work = self._messages
            self.service.beat()
            time.sleep(_POLL_S)
        self.service.finish()
        if not self.service.running:
            self._server.stop()

    def on_subscribe(self, client: "Client", channel: "ChannelView") -> None:
        """Send the state in force again, for a new subscriber; called by the server."""
        self.subscriptions.add((client.id, channel.topic))
        last = self.last_states.get(channel.topic.removeprefix("/"))
        if last is not None:
            self._channels[last.key].log(last.payload, log_time=last.publish_time_ns)

    def on_unsubscribe(self, client: "Client", channel: "ChannelView") -> None:
        """Forget a subscription; called by the server."""
        self.subscriptions.discard((client.id, channel.topic))

    def _publish(self, topic: Topic, sample: Sample) -> None:
        self._names.admit(topic, sample.key)
        if topic.queryable:
            self.last_states[sample.key] = sample
        self._messages += 1
        self._channel(topic, sample.key).log(sample.payload, log_time=sample.publish_time_ns)

    def _channel(self, topic: Topic, key: str) -> "Channel":
        with self._channels_lock:  # two threads may publish on a new key at once
            if key not in self._channels:
                self._channels[key] = self._foxglove.Channel(
                    "/" + key,
                    schema=self._foxglove.Schema(
                        name=topic.message.DESCRIPTOR.full_name,
                        encoding="protobuf",
                        data=declaration(topic.message).SerializeToString(),
                    ),
                    message_encoding="protobuf",
                    context=self._context,
                    metadata={"description": topic.description},
                )
            return self._channels[key]


def serve_foxglove(run_id: str, clock: Clock, port: int) -> None:
    """Serve a run, and each later run of the same name, until SIGTERM or SIGINT; see `FoxgloveBridge`."""
    bridge: FoxgloveBridge | None = None
    while bridge is None or bridge.service.running:
        joined = open_run(run_id, ())
        with contextlib.closing(ZenohBus(joined.links, Role.VIEWER, clock, monitor=True)) as bus:
            earlier = None if bridge is None else bridge.service
            if bridge is None:
                bridge = FoxgloveBridge(bus, clock, run_id, port)
            else:
                bridge.join(bus)
            bridge.service.catch_signals()
            if earlier is not None and not earlier.running:  # a signal has arrived meanwhile
                bridge.service.stop(earlier.why)
            sys.stderr.write(f"serving run {run_id!r} at ws://{HOST}:{bridge.port}; Ctrl-C ends it\n")
            bridge.run(joined.restarted)
