"""Camera settings that a controller receives before the first frame."""

from unittest.mock import Mock

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.process.clock import SimulatedClock
from lowfc.contract.envelope import sequence_of
from lowfc.contract.messages import CAMERA_STATE, timestamp, wire
from lowfc.control.loop.camera import CameraSettings
from lowfc.programs.core.camera_reports import CameraReports


def test_settings_received_before_the_first_frame_of_a_lockstep_run_are_timed_at_the_start_of_the_run() -> None:
    """The camera publishes settings at its start and with its first frame; the query may return either."""
    clock, received = SimulatedClock(), list[CameraSettings]()
    state = wire.CameraState(timestamp=timestamp(clock.now_ns() + 10_000_000), rows=6, columns=7)
    answer = Sample(CAMERA_STATE.key, state.SerializeToString(), sequence_of(1, 1), 1, 1)
    service = Mock(running=True, clock=clock, bus=Mock(get=Mock(return_value=[answer])))
    CameraReports(service, received.append).await_first()
    assert [settings.time_ns for settings in received] == [clock.now_ns()]
