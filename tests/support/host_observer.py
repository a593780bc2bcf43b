"""Print what one host of a multi-host run receives, ten times a second as a line of JSON on standard error.

`good`: number of consecutive steps, up to the newest, with the loop closed, no refusal or limit, and errors below 5 nm.
`following`: number of consecutive states, up to the newest, in which the mirror follows commands.
"""

import json
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.configuration import load
from lowfc.contract.messages import EVENT, MIRROR_STATE, STEP, Log, wire


def main(run: str, config: str, role: str) -> None:
    links = open_run(run, network=load(Path(config)).network).links
    bus = ZenohBus(links, role, HostClock())
    events = Counter[str]()

    def count_event(sample: Sample) -> None:
        log = Log.FromString(sample.payload)
        events[f"{log.name} {log.message.split(' ')[0]}"] += 1

    bus.subscribe(EVENT, count_event)
    steps, states = bus.ring(STEP, 1000), bus.ring(MIRROR_STATE, 1000)
    good = following = 0
    while True:
        time.sleep(0.1)
        new_steps = [wire.ControlStep.FromString(sample.payload) for sample in steps.drain()]
        for step in new_steps:
            closed = step.mode == wire.LOOP_MODE_CLOSED and not step.reasons
            good = good + 1 if closed and np.abs(step.error_nm).max() < 5 else 0
        new_states = [wire.MirrorState.FromString(sample.payload) for sample in states.drain()]
        for state in new_states:
            following = following + 1 if state.status == wire.MIRROR_STATUS_FOLLOWING else 0
        line = {
            "steps": len(new_steps),
            "good": good,
            "states": len(new_states),
            "following": following,
            "status": wire.MirrorStatus.Name(new_states[-1].status) if new_states else "",
            "highest_nm": float(max((np.abs(np.frombuffer(s.actuators, "<f4")).max() for s in new_states), default=0)),
            "events": events,
        }
        sys.stderr.write(json.dumps(line) + "\n")
        sys.stderr.flush()


main(*sys.argv[1:])
