"""The launcher's record of a run, and its summary from the last Health of each process."""

from dataclasses import dataclass, field
from typing import Any

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.names import Names
from lowfc.contract.messages import FRAME, Log, Role, wire
from lowfc.control.loop.safety import mode_name as name_of_mode
from lowfc.optics.chain.added_contrast import beyond_quadratic


@dataclass(slots=True)
class Watch:
    """The last Health of each process and the last events."""

    health: dict[str, wire.Health]
    events: list[Log]
    _names: Names = field(default_factory=Names)

    def health_of(self, name: str) -> wire.Health:
        """Last Health of a process; empty before the first."""
        return self.health.get(name, wire.Health())

    def silent_s(self, name: str) -> float:
        """Time from a process's last Health to the newest Health of all processes."""
        newest_ns = max((health.timestamp.ToNanoseconds() for health in self.health.values()), default=0)
        return (newest_ns - self.health_of(name).timestamp.ToNanoseconds()) * 1e-9

    def add_health(self, sample: Sample) -> None:
        """Store a Health."""
        name, health = self._names.health(sample.key, sample.payload)
        self.health[name] = health

    def add_event(self, sample: Sample) -> None:
        """Store an event; the last 100 are kept."""
        self.events.append(Log.FromString(sample.payload))
        del self.events[:-100]


def summary(watch: Watch, record: bool, lockstep_hz: float | None = None) -> dict[str, Any]:
    """Summary of a run, from the last Health of each process; `lockstep_hz` is the frame rate in simulated time."""
    camera, controller = watch.health_of(Role.CAMERA), watch.health_of(Role.CONTROLLER)
    frames, not_closed_s = topic_count(controller, FRAME.key), controller.not_closed_ns * 1e-9
    periods = frames.received - 1  # from the first frame to the last
    rate_hz = camera.mean_rate_hz if lockstep_hz is None else lockstep_hz
    results: dict[str, Any] = {
        "rate_hz": round(camera.mean_rate_hz, 2),
        "frames_published": topic_count(camera, FRAME.key).published,
        "frames_processed": frames.received - frames.skipped,
        "frames_skipped": frames.skipped,
        "frames_missing": frames.missing,
        "commands_applied": camera.frame_to_mirror.count,
        "commands_late": camera.commands_late,
        "mode": mode_name(controller.mode),
        "closed_fraction": round(max(0.0, 1 - not_closed_s * rate_hz / periods), 4) if periods > 0 else 0.0,
        "not_closed_s": round(not_closed_s, 3),
        "not_closed_cause": controller.not_closed_cause,
        "messages_recorded": None,
        "messages_lost": None,
        "lost": {},
        "recording_failure": None,
        **wavefront(camera.wavefront),
        "latency_us": {
            "frame_to_command": _microseconds(controller.frame_to_command),
            "frame_to_mirror": _microseconds(camera.frame_to_mirror),
        },
        "realtime_granted": list(controller.realtime_granted),
        "realtime_refused": list(controller.realtime_refused),
        "log": None,
        "logs": [],
    }
    if record:
        recorder = watch.health_of(Role.RECORDER)
        recording, frames_in_log = recorder.recording, topic_count(recorder, FRAME.key)
        lost = {topic.topic: topic.missing for topic in recorder.topics if topic.missing}
        # A recorder that misses the camera's last Health does not count frames lost after the last recorded one.
        uncounted = results["frames_published"] - frames_in_log.received - frames_in_log.missing
        if frames_in_log.received and uncounted > 0:
            lost[FRAME.key] = frames_in_log.missing + uncounted
        results |= {
            "messages_recorded": recording.messages,
            "messages_lost": max(recording.lost, sum(lost.values())),
            "lost": lost,
            "recording_failure": recording.failure or None,
            "log": recording.file,
            "logs": list(recording.files),
        }
    return results


def wavefront(figures: wire.WavefrontFigures) -> dict[str, Any]:
    """Statistics of the true wavefront: continuous in time if available, and sampled at the exposure starts."""
    names = ("disturbance_rms_nm", "residual_rms_nm", "tilt_disturbance_mas", "tilt_residual_mas")
    kind = "continuous_" if figures.instants else ""
    return {
        **{name: round(getattr(figures, kind + name), 4) for name in names},
        "sampled_residual_rms_nm": round(figures.residual_rms_nm, 4),
        "sampled_tilt_residual_mas": round(figures.tilt_residual_mas, 4),
        "instants_per_frame": figures.instants or 1,
        "added_contrast": {"open": figures.added_contrast_flat, "closed": figures.added_contrast}
        if figures.added_contrast_flat
        else None,
        "costliest_modes": {"modes": figures.costliest_modes, "share": round(figures.costliest_share, 3)}
        if figures.costliest_modes
        else None,
        "beyond_quadratic": beyond_quadratic(figures.quadratic_added_contrast, figures.added_contrast)
        if figures.science_images
        else None,
        "dark_zone_contrast": figures.dark_zone_contrast or None,
    }


def mode_name(mode: wire.LoopMode) -> str | None:
    """Name of the loop mode; None before a controller has reported a mode."""
    return name_of_mode(mode) if mode else None


def topic_count(health: wire.Health, key: str) -> wire.TopicCount:
    """A process's counts of a topic; zeros if it reports none."""
    return next((topic for topic in health.topics if topic.topic == key), wire.TopicCount())


def _microseconds(latency: wire.Latency) -> dict[str, float]:
    return {name: getattr(latency, f"{name}_ns") / 1e3 for name in ("p50", "p99", "p99_9", "max")}
