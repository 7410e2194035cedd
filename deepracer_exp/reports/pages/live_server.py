"""The server of a live page: one page and its version, for this machine only."""

import re
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from deepracer_exp.errors import BadInput

HOST = "127.0.0.1"
_NAMES = (HOST, "localhost", "[::1]")
"""Names of this machine; the port is not compared, since through a tunnel it is another one."""


class LiveServer(ThreadingHTTPServer):
    """Serves a page at `/` and its version at `/version`; the page reloads itself when that changes.

    Attributes:
        shown: the version and the page, replaced together.
    """

    daemon_threads = True

    def __init__(self, port: int) -> None:
        """Open a port, 0: a free one.

        Raises:
            BadInput: the port is in use.
        """
        self.shown = ("0", "")
        try:
            super().__init__((HOST, port), _Answer)
        except OSError as error:
            reason = str(error.strerror or error).lower()
            raise BadInput(
                f"--port {port}", f"{reason} on {HOST}", "a free port, or no --port for any"
            ) from None

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Show the traceback of a bug, but nothing where a browser left before it had the page."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server_port}/"


class _Answer(BaseHTTPRequestHandler):
    server: LiveServer

    def do_GET(self) -> None:
        # A foreign page whose host name leads here (DNS rebinding) could read the answer.
        if re.sub(r":\d+$", "", self.headers.get("Host", "")) not in _NAMES:
            self.send_error(421, "accepted: " + " or ".join(_NAMES))
            return
        version, page = self.server.shown
        answers = {"/": (page, "text/html"), "/version": (version, "text/plain")}
        text, kind = answers.get(self.path, ("no such page\n", "text/plain"))
        body = text.encode()
        self.send_response(200 if self.path in answers else 404)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: the page asks every second."""
