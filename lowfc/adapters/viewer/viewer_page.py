"""Proxy for the web viewer's page that adds a content security policy, so that the page contacts this host only.

Served by rerun 0.41 itself, the page sends usage statistics, checks for a newer version and fetches a font over the
network; no setting prevents this.
"""

import http.client
import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

_TIMEOUT_S = 60.0  # on a loaded host the viewer pauses for more than 10 s, and a page that is cut short does not start
_CHUNK_BYTES = 1 << 20
_FORWARDED_HEADERS = ("Content-Type", "rerun-final-length")  # the second is used by the page's progress bar


class ViewerPage:
    """Serves the content of another server on this host, with the content security policy added, until stop()."""

    def __init__(self, host: str, port: int, source_port: int, stream_port: int) -> None:
        """Listen at `host` and `port`, and serve the content of `source_port`; OSError if `port` is in use.

        The page may connect only to this server and to `stream_port`.
        """
        own_sources = "'self' 'unsafe-inline' 'wasm-unsafe-eval' data: blob:"
        policy = f"default-src {own_sources}; connect-src {own_sources} http://{host}:{stream_port}"

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                source = http.client.HTTPConnection(host, source_port, timeout=_TIMEOUT_S)
                try:
                    source.request("GET", self.path)
                    answer = source.getresponse()
                    self.send_response(answer.status)
                    for name in _FORWARDED_HEADERS:
                        if value := answer.getheader(name):
                            self.send_header(name, value)
                    self.send_header("Content-Security-Policy", policy)
                    self.end_headers()
                    shutil.copyfileobj(answer, self.wfile, _CHUNK_BYTES)
                except (OSError, http.client.HTTPException):
                    self.close_connection = True  # the viewer or the browser is gone
                finally:
                    source.close()

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # the base class's name
                """Print nothing: standard error is the user's."""

        self._server = ThreadingHTTPServer((host, port), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, name="viewer-page", daemon=True).start()

    def stop(self) -> None:
        """Stop serving and close the port."""
        self._server.shutdown()
        self._server.server_close()
