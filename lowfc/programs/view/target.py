"""Target of a view: a window, a page for the browser, a picture or a file."""

import sys
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from lowfc.adapters.bus.run import free_ports
from lowfc.adapters.viewer.rerun_viewer import RerunViewer, Show, has_screen
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.printable import encodable
from lowfc.programs.view.draw.tabs import Tab
from lowfc.programs.view.layout import APPLICATION, layout


@dataclass(slots=True)
class Target:
    """One of window, page, file and picture; by default a window, or a page if there is no screen.

    `part`: path of the file while it is being written.
    """

    native: bool = False
    web: bool = False
    save: Path | None = None
    picture: Path | None = None
    tab: Tab = Tab.OPERATOR
    memory_mb: float = 512.0
    port: int = 0
    web_port: int = 0
    part: Path | None = None

    def __post_init__(self) -> None:
        """Check the target, and choose the ports.

        Raises:
            ConfigurationError: two targets, a wrong file name, equal ports, or a port that the target does not have.
        """
        files = {"--save": (self.save, ".rrd"), "--headless-screenshot": (self.picture, ".png")}
        options = {"--native": self.native, "--web": self.web} | {option: file for option, (file, _) in files.items()}
        chosen = [name for name, given in options.items() if given]
        if len(chosen) > 1:
            raise ConfigurationError(f"a view has one target; got {' and '.join(chosen)}: use one")
        for option, (file, suffix) in files.items():
            if file is not None and file.suffix != suffix:
                raise ConfigurationError(f"{option} requires a file name that ends in {suffix}; got {file}")
        if encodable(str(self.save)) != str(self.save):
            raise ConfigurationError(f"--save: rerun writes only files with a name in UTF-8; got {self.save}")
        if self.port and self.port == self.web_port:
            raise ConfigurationError(f"--port and --web-port must differ; both are {self.port}")
        if self.port and self.show is None:
            raise ConfigurationError("--port is the port of a viewer; --save starts no viewer")
        if self.web_port and self.show is not Show.WEB:
            raise ConfigurationError("--web-port is the port of a page: add --web")
        free = free_ports(2)  # now, so that a restarted viewer has the same ports
        self.port, self.web_port = self.port or free[0], self.web_port or free[1]

    @property
    def show(self) -> Show | None:
        """Kind of the viewer; None if a file is written."""
        if self.save is not None:
            return None
        if self.picture is not None:
            return Show.HEADLESS
        return Show.WEB if self.web or not (self.native or has_screen()) else Show.NATIVE

    @property
    def written(self) -> Path | None:
        """Path of the file or picture to write; None for a window or page."""
        return self.save or self.picture

    def viewer(self) -> RerunViewer | None:
        """Start the viewer; None if a file is written. ViewerError if it cannot be started."""
        if self.show is None:
            return None
        memory = f"{self.memory_mb:.0f}MB"
        return RerunViewer(self.show, memory_limit=memory, port=self.port, web_port=self.web_port)

    def stream(self, viewer: RerunViewer | None, recording: str, window_s: float | None) -> rr.RecordingStream:
        """Stream to the viewer, or into the file; plots show the last `window_s` seconds.

        If `window_s` is None, the viewer chooses what the plots show, until `show_all`.

        Data that the viewer does not read is buffered; when the buffer is full, the stream blocks.
        """
        stream = rr.RecordingStream(APPLICATION, recording_id=encodable(recording))
        stream.set_log_time_enabled(False)  # one timeline, that of the data
        stream.set_log_tick_enabled(False)
        if viewer is not None:
            stream.connect_grpc(viewer.url)
        else:
            stream.save(str(self.part))
        stream.send_blueprint(layout(self.tab, window_s))
        return stream

    def show_all(self, stream: rr.RecordingStream, span_ns: tuple[int, int] | None) -> None:
        """Make the plots show the whole log, after it was sent; a picture omits the panels that show only its end."""
        stream.send_blueprint(layout(self.tab, None, span_ns=span_ns, still=self.picture is not None))

    def print_address(self, viewer: RerunViewer | None) -> None:
        """Print the address of the page."""
        if viewer is not None and viewer.web_address is not None:
            sys.stderr.write(f"view: {viewer.web_address}\nCtrl-C ends it\n")
