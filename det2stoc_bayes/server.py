"""Results over HTTP, to this machine alone unless told otherwise: a list, two runs side by side, and their files.

The standard library's server suffices: three addresses, nothing is written, nothing is run.
"""

import errno
import shutil
import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.report import results
from det2stoc_bayes.report.results_page import beside_page, list_page

TYPES = {".html": "text/html; charset=utf-8", ".json": "application/json", ".nc": "application/octet-stream"}
TYPES |= dict.fromkeys((".xml", ".py", ".csv", ".jsonl", ".toml", ".txt", ".log", ".md"), "text/plain; charset=utf-8")
INLINE = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
ANSWERS = {  # a report is a page of its own: it sees nothing of the others
    "page": f"{INLINE}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "file": f"{INLINE}; sandbox allow-scripts allow-downloads; base-uri 'none'; form-action 'none'",
}
SECONDS = 30  # that a request may take to arrive


class Results(ThreadingHTTPServer):
    """Serves a folder; `url` is where."""

    daemon_threads = True

    def __init__(self, root: Path, host: str = "127.0.0.1", port: int = 8765):
        if not root.is_dir():
            raise Det2StocError(f"{root}: found no folder; allowed: one with results of det2stoc")
        self.root, self.host = root.resolve(), host
        try:
            super().__init__((host, port), Handler)
        except OSError as error:
            raise Det2StocError(_refused(host, port, error)) from error

    @property
    def url(self) -> str:
        """Where the list is."""
        return f"http://{self.host}:{self.server_port}/"

    @property
    def is_local(self) -> bool:
        """Whether this machine alone can reach it."""
        return ip_address(str(self.server_address[0])).is_loopback

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no one's error."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class Handler(BaseHTTPRequestHandler):
    """Answers GET and HEAD."""

    server: Results
    server_version, sys_version = "det2stoc", ""
    timeout = SECONDS

    def do_GET(self) -> None:
        """The list, a comparison, or a file."""
        if not self._known_host():
            return self._refuse(HTTPStatus.FORBIDDEN, "asked for under a foreign name")
        asked = urlsplit(self.path)
        try:
            if asked.path == "/":
                return self._page(list_page(results.find(self.server.root), str(self.server.root)))
            if asked.path == "/compare":
                query = parse_qs(asked.query)
                return self._page(beside_page(*(self._result(query.get(key, [""])[0]) for key in ("a", "b"))))
            if asked.path.startswith("/files/"):
                return self._file(self._inside(unquote(asked.path.removeprefix("/files/"))))
        except Det2StocError as error:
            return self._refuse(HTTPStatus.NOT_FOUND, str(error))
        except (OSError, ValueError):
            return self._refuse(HTTPStatus.NOT_FOUND, "cannot be read")
        return self._refuse(HTTPStatus.NOT_FOUND, "found no such page; allowed: /")

    do_HEAD = do_GET

    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing of every request."""

    def _known_host(self) -> bool:
        """Whether the browser means this server: a foreign name that resolves here could read along."""
        name = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        return not self.server.is_local or name in (self.server.host, "localhost", "127.0.0.1", "::1")

    def _result(self, folder: str) -> results.Result:
        if not folder:
            raise Det2StocError("found no folder; allowed: /compare?a=FOLDER&b=FOLDER")
        home = self._inside(folder)
        return results.read(self.server.root, home.relative_to(self.server.root).as_posix())

    def _inside(self, asked: str) -> Path:
        """A path below the root: nothing hidden, no way up, no link out."""
        parts = PurePosixPath(asked).parts
        if "\\" in asked or "\0" in asked or any(p == "/" or p.startswith(".") for p in parts):
            raise Det2StocError("found a path that leads out of the folder, or to something hidden")
        path = self.server.root.joinpath(*parts)
        if not path.resolve().is_relative_to(self.server.root):
            raise Det2StocError("found a path that leads out of the folder")
        return path

    def _page(self, text: str) -> None:
        data = text.encode("utf-8")
        self._head(TYPES[".html"], len(data), "page")
        if self.command == "GET":
            self.wfile.write(data)

    def _file(self, path: Path) -> None:
        kind = TYPES.get(path.suffix)
        if kind is None or not path.is_file():
            raise Det2StocError(f"found no such file, or none of {', '.join(TYPES)}")
        with path.open("rb") as file:
            self._head(kind, path.stat().st_size, "file")
            if self.command == "GET":
                shutil.copyfileobj(file, self.wfile)

    def _head(self, kind: str, length: int, policy: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        told = {"Content-Type": kind, "Content-Length": str(length), "Content-Security-Policy": ANSWERS[policy]}
        told |= {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cache-Control": "no-store"}
        told |= {"Cross-Origin-Resource-Policy": "same-origin"}
        for name, value in told.items():
            self.send_header(name, value)
        self.end_headers()

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        data = f"{status.value}: {why}\n".encode()
        self._head(TYPES[".txt"], len(data), "page", status)
        if self.command == "GET":
            self.wfile.write(data)


def _refused(host: str, port: int, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"--port {port}: found in use on {host}; allowed: another one, or 0 for any that is free"
    if error.errno == errno.EACCES:
        return f"--port {port}: found one that needs more rights; allowed: 1024 to 65535, or 0 for any that is free"
    return f"--host {host}: found no address of this machine ({error.strerror}); allowed: 127.0.0.1, or one of its own"
