"""Where a view is shown: a window, a page for the browser, a picture or a file."""

from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from lowfc.adapters.rerun_viewer import RerunViewer, Show, has_screen
from lowfc.adapters.run import free_ports
from lowfc.contract.errors import ConfigurationError
from lowfc.programs.view.layout import layout
from lowfc.programs.view.stream import to_file, to_viewer
from lowfc.programs.view.tabs import Tab


@dataclass(frozen=True, slots=True)
class Place:
    """One of four; see `place`.

    Attributes:
        show: kind of the viewer; None where a file is written.
        save: file (RRD), or None.
        picture: file (PNG) of a headless viewer, or None.
        tab: that is opened.
        memory_mb: what a viewer keeps of the past.
        port, web_port: of the viewer, each time it is started.
    """

    show: Show | None
    save: Path | None
    picture: Path | None
    tab: Tab
    memory_mb: float
    port: int
    web_port: int

    def viewer(self) -> RerunViewer:
        """Start the viewer.

        Raises:
            ViewerError: it cannot be started.
        """
        assert self.show is not None  # noqa: S101  # a file has none
        memory = f"{self.memory_mb:.0f}MB"
        return RerunViewer(self.show, memory_limit=memory, port=self.port, web_port=self.web_port)

    def stream(
        self, viewer: RerunViewer | None, part: Path | None, recording: str, window_s: float | None
    ) -> rr.RecordingStream:
        """Stream to the viewer, or into a file; plots show the last `window_s` seconds, or what `show_whole` says."""
        blueprint = layout(self.tab, window_s)
        if viewer is not None:
            return to_viewer(viewer.url, recording, blueprint)
        assert part is not None  # noqa: S101  # there is a viewer or a file
        return to_file(part, recording, blueprint)

    def show_whole(self, stream: rr.RecordingStream, span_ns: tuple[int, int] | None) -> None:
        """Let the plots show all of a log that was drawn; a picture has nothing of its last instant alone."""
        stream.send_blueprint(layout(self.tab, None, span_ns=span_ns, still=self.picture is not None))


def place(
    *,
    native: bool,
    web: bool,
    save: Path | None,
    picture: Path | None,
    tab: Tab,
    memory_mb: float,
    port: int | None,
    web_port: int | None,
) -> Place:
    """The place that options name; without one a window, or a page where there is no screen.

    Raises:
        ConfigurationError: they name two.
    """
    given = {"--native": native, "--web": web, "--save": save, "--headless-screenshot": picture}
    chosen = [name for name, wanted in given.items() if wanted]
    if len(chosen) > 1:
        raise ConfigurationError(f"a view is in one place; got {' and '.join(chosen)}: choose one")
    for option, file, suffix in (("--save", save, ".rrd"), ("--headless-screenshot", picture, ".png")):
        if file is not None and file.suffix != suffix:
            raise ConfigurationError(f"{option} writes a file that ends in {suffix}; got {file}")
    if port is not None and port == web_port:
        raise ConfigurationError(f"--port and --web-port must differ; both are {port}")
    if save is not None:
        show = None
    elif picture is not None:
        show = Show.HEADLESS
    else:
        show = Show.WEB if web or not (native or has_screen()) else Show.NATIVE
    free = free_ports(2)  # now, so that a viewer that is started again is where it was
    return Place(show, save, picture, tab, memory_mb, port or free[0], web_port or free[1])
