"""The web viewer's page, served again with a rule that keeps it on this host.

As rerun 0.41 serves it, the page sends usage statistics, asks for a newer version and fetches a font, each from
somewhere on the network, and has no setting against it; but a browser obeys a content security policy.
"""

import http.client
import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

_PATIENCE_S = 10.0
_CHUNK_BYTES = 1 << 20
_PASSED_ON = ("Content-Type", "rerun-final-length")  # the second is for the page's progress bar


class ViewerPage:
    """Serves what another server on this host serves, with the policy added, until stop()."""

    def __init__(self, host: str, port: int, source_port: int, stream_port: int) -> None:
        """Listen at `host` and `port`, and serve what is at `source_port`; OSError where the port is taken.

        The page may ask nobody but this server and the stream.
        """
        own = "'self' 'unsafe-inline' 'wasm-unsafe-eval' data: blob:"
        policy = f"default-src {own}; connect-src {own} http://{host}:{stream_port}"

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                source = http.client.HTTPConnection(host, source_port, timeout=_PATIENCE_S)
                try:
                    source.request("GET", self.path)
                    answer = source.getresponse()
                    self.send_response(answer.status)
                    for name in _PASSED_ON:
                        if value := answer.getheader(name):
                            self.send_header(name, value)
                    self.send_header("Content-Security-Policy", policy)
                    self.end_headers()
                    shutil.copyfileobj(answer, self.wfile, _CHUNK_BYTES)
                except (OSError, http.client.HTTPException):
                    self.close_connection = True  # the viewer is gone, or the browser
                finally:
                    source.close()

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # the base class's name
                """Print nothing: standard error is the user's."""

        self._server = ThreadingHTTPServer((host, port), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, name="viewer-page", daemon=True).start()

    def stop(self) -> None:
        """Close the port."""
        self._server.shutdown()
        self._server.server_close()
