"""Where a view is shown: a window, a page for the browser, a picture or a file."""

from dataclasses import dataclass
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from lowfc.adapters.bus.run import free_ports
from lowfc.adapters.viewer.rerun_viewer import RerunViewer, Show, has_screen
from lowfc.contract.errors import ConfigurationError
from lowfc.programs.view.draw.tabs import Tab
from lowfc.programs.view.layout import APPLICATION, layout


@dataclass(slots=True)
class Target:
    """At most one of window, page, file and picture; by default a window, or a page where there is no screen."""

    native: bool = False
    web: bool = False
    save: Path | None = None
    picture: Path | None = None
    tab: Tab = Tab.OPERATOR
    memory_mb: float = 512.0
    port: int = 0
    web_port: int = 0

    def __post_init__(self) -> None:
        """Check it, and choose the ports.

        Raises:
            ConfigurationError: two are named, or one that cannot be.
        """
        named = {
            "--native": self.native,
            "--web": self.web,
            "--save": self.save,
            "--headless-screenshot": self.picture,
        }
        chosen = [name for name, wanted in named.items() if wanted]
        if len(chosen) > 1:
            raise ConfigurationError(f"a view is in one place; got {' and '.join(chosen)}: choose one")
        for option, file, suffix in (("--save", self.save, ".rrd"), ("--headless-screenshot", self.picture, ".png")):
            if file is not None and file.suffix != suffix:
                raise ConfigurationError(f"{option} writes a file that ends in {suffix}; got {file}")
        if self.port and self.port == self.web_port:
            raise ConfigurationError(f"--port and --web-port must differ; both are {self.port}")
        free = free_ports(2)  # now, so that a viewer that is started again is where it was
        self.port, self.web_port = self.port or free[0], self.web_port or free[1]

    @property
    def show(self) -> Show | None:
        """Kind of the viewer; None where a file is written."""
        if self.save is not None:
            return None
        if self.picture is not None:
            return Show.HEADLESS
        return Show.WEB if self.web or not (self.native or has_screen()) else Show.NATIVE

    @property
    def written(self) -> Path | None:
        """The file or picture."""
        return self.save or self.picture

    def viewer(self) -> RerunViewer | None:
        """Start the viewer; None where a file is written.

        Raises:
            ViewerError: it cannot be started.
        """
        if self.show is None:
            return None
        memory = f"{self.memory_mb:.0f}MB"
        return RerunViewer(self.show, memory_limit=memory, port=self.port, web_port=self.web_port)

    def stream(
        self, viewer: RerunViewer | None, part: Path | None, recording: str, window_s: float | None
    ) -> rr.RecordingStream:
        """Stream to the viewer, or into a file; plots show the last `window_s` seconds, or as `show_all` sets."""
        blueprint = layout(self.tab, window_s)
        if viewer is not None:
            return to_viewer(viewer.url, recording, blueprint)
        stream = _stream(recording)
        stream.save(str(part))
        stream.send_blueprint(blueprint)
        return stream

    def show_all(self, stream: rr.RecordingStream, span_ns: tuple[int, int] | None) -> None:
        """Let the plots show all of a log that was drawn; a picture has nothing of its last instant alone."""
        stream.send_blueprint(layout(self.tab, None, span_ns=span_ns, still=self.picture is not None))


def to_viewer(url: str, recording: str, blueprint: rrb.Blueprint) -> rr.RecordingStream:
    """Stream of that name to a viewer that listens at `url`; what it does not take waits, and then holds up."""
    stream = _stream(recording)
    stream.connect_grpc(url)
    stream.send_blueprint(blueprint)
    return stream


def _stream(recording: str) -> rr.RecordingStream:
    stream = rr.RecordingStream(APPLICATION, recording_id=recording)
    stream.set_log_time_enabled(False)  # one timeline, that of the data
    stream.set_log_tick_enabled(False)
    return stream
