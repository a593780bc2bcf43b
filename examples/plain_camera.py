"""A camera that uses only zenoh, protobuf and the compiled messages, like a program in another language.

It publishes a numpy file of frames (frames, rows, columns) uint16 in a loop.

Example: lowfc config zenoh --run bench --role camera --make > camera.json5
         python examples/plain_camera.py camera.json5 frames.npy
"""

import json
import struct
import sys
import time
from pathlib import Path

import numpy as np
import zenoh
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from lowfc.contract.wire.lowfc_pb2 import CameraState, Health  # compiled by protoc from lowfc/contract/proto

PERIOD_NS, EXPOSURE_NS, SETTINGS_PERIOD_NS = 4_000_000, 2_000_000, 500_000_000

SESSION, FRAMES = Path(sys.argv[1]), np.load(sys.argv[2])
# The host's time never steps: CLOCK_MONOTONIC plus an offset in a file of this boot, shared by the user's processes.
base = Path(json.loads(SESSION.read_text())["transport"]["auth"]["usrpwd"]["dictionary_file"]).parents[1]
boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
OFFSET_NS = int((base / f"clock-{boot}").read_text())


def now_ns() -> int:
    """Nanoseconds since the epoch."""
    return time.monotonic_ns() + OFFSET_NS


START_S = now_ns() // 1_000_000_000


class Publisher:
    """Publish messages with an envelope of 16 bytes: start << 32 | count, and the publication time, little-endian."""

    def __init__(self, session: zenoh.Session, key: str, *, queryable: bool = False) -> None:
        """Publish on a key; if queryable, also reply to queries with the last message."""
        self.key, self.count, self.last = key, 0, (b"", b"")
        self._publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        if queryable:
            session.declare_queryable(key, self._reply)

    def _reply(self, query: zenoh.Query) -> None:
        payload, envelope = self.last
        if envelope:  # not before the first message
            query.reply(self.key, payload, attachment=envelope)

    def put(self, payload: bytes) -> None:
        """Send a message."""
        self.last = (payload, struct.pack("<QQ", START_S << 32 | self.count, now_ns()))
        self._publisher.put(payload, attachment=self.last[1])
        self.count += 1


session = zenoh.open(zenoh.Config.from_file(str(SESSION)))
frames, states = Publisher(session, "lowfc/camera/frame"), Publisher(session, "lowfc/camera/state", queryable=True)
health = Publisher(session, "lowfc/health/camera", queryable=True)
_, rows, columns = FRAMES.shape
image = RawImage(encoding="mono16", height=rows, width=columns, step=2 * columns, frame_id="my_camera")
settings = CameraState(rows=rows, columns=columns, exposure_ns=EXPOSURE_NS, period_ns=PERIOD_NS, bit_depth=16)
settings.gain_e_per_dn, settings.bias_dn, settings.saturation_dn, settings.em_gain = 1.0, 100.0, 40_100.0, 1.0
health_message = Health(process="camera", state="running")
end_ns, settings_due_ns = now_ns(), 0
while True:
    end_ns = max(end_ns + PERIOD_NS, now_ns())
    time.sleep(max(0, end_ns - now_ns()) * 1e-9)
    image.timestamp.FromNanoseconds(end_ns)
    image.data = FRAMES[frames.count % len(FRAMES)].astype("<u2").tobytes()
    frames.put(image.SerializeToString())
    if end_ns >= settings_due_ns:
        settings.timestamp.FromNanoseconds(end_ns)
        states.put(settings.SerializeToString())
        health_message.timestamp.FromNanoseconds(now_ns())
        del health_message.topics[:]
        health_message.topics.add(topic=frames.key, published=frames.count)
        health.put(health_message.SerializeToString())
        settings_due_ns = end_ns + SETTINGS_PERIOD_NS
