"""Small HTTP servers on this machine that answer as no MLflow server should."""

import contextlib
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

SAID = {"403": b"<p>Invalid\x1b Host\nheader</p>"}
"""What is said besides a status."""


@contextlib.contextmanager
def odd_server(answer: str) -> Iterator[str]:
    """Serve and yield the address: every request is answered by `answer`.

    It is an HTTP status, `hang` (nothing is sent), `drip` (a byte now and then, without an end), or a body.
    """
    over = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.rfile.read(int(self.headers.get("Content-Length") or 0))
            if answer == "hang":
                over.wait()
                return
            self.send_response(int(answer) if answer.isdigit() else 200)
            body = SAID.get(answer, b"" if answer.isdigit() else answer.encode())
            self.send_header("Content-Length", "1000000" if answer == "drip" else str(len(body)))
            self.end_headers()
            if answer == "drip":
                while not over.wait(0.1):
                    self.wfile.write(b" ")
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    for method in ("POST", "PUT", "PATCH", "DELETE"):
        setattr(Handler, f"do_{method}", Handler.do_GET)

    class Server(ThreadingHTTPServer):
        daemon_threads = True

        def handle_error(self, *_: object) -> None:  # a client that has gone
            pass

    with Server(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            over.set()
            server.shutdown()
