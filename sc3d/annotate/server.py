"""HTTP for the annotation page, on the loopback address only.

What keeps others out: requests under another name or from another page are refused (`sc3d.io.local_page`),
and whatever writes or computes must come from the page's own origin and carry the token that only this page
was given. Photos are found by their names in a list, never by a path.
"""

from __future__ import annotations

import hmac
import json
import logging
import secrets
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from socketserver import TCPServer
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

from sc3d.annotate.asking import StaleError
from sc3d.annotate.session import BusyError, Session
from sc3d.annotate.suggestions import Suggestions
from sc3d.errors import InputError
from sc3d.io.local_page import LocalPage

logger = logging.getLogger(__name__)

ADDRESS = "127.0.0.1"
LARGEST_BODY = 8 << 20  # bytes
PORTS_TRIED = 20
STATIC = {
    "/": ("page.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/ask.js": ("ask.js", "text/javascript"),
    "/canvas.js": ("canvas.js", "text/javascript"),
    "/drawing.js": ("drawing.js", "text/javascript"),
    "/style.css": ("style.css", "text/css"),
}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Refusal(Exception):
    """A request that is not answered; status and a line for the page."""

    def __init__(self, status: HTTPStatus, message: str) -> None:
        super().__init__(message)
        self.status = status


class Answer(NamedTuple):
    """Body and its media type."""

    body: bytes
    kind: str


class AnnotationServer(ThreadingHTTPServer):
    """Serves one session; `serve_forever` until `shutdown`."""

    daemon_threads = True
    allow_reuse_address = False  # two servers on one port would share its requests

    def __init__(self, session: Session, port: int, handler: type[Handler] | None = None) -> None:
        """Bind to the port or one of the next; 0 = any. Raises InputError if none is free."""
        self.session = session
        self.token = secrets.token_urlsafe(32)
        for candidate in range(port, port + PORTS_TRIED) if port else (0,):
            try:
                super().__init__((ADDRESS, candidate), handler or Handler)
                break
            except (OSError, OverflowError):
                continue
        else:
            raise InputError(
                f"no free port from {port} to {port + PORTS_TRIED - 1}: choose another with --port"
            )
        self.page = LocalPage(port=self.server_port)

    @property
    def url(self) -> str:
        return f"http://{ADDRESS}:{self.server_port}/"

    def server_bind(self) -> None:
        """Without the look-up of the machine's name that HTTPServer does, which may take seconds."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = ADDRESS, self.socket.getsockname()[1]

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that leaves in the middle of an answer is no error."""
        logger.debug("connection of %s ended", client_address, exc_info=True)


class Handler(BaseHTTPRequestHandler):
    """One request: checked, looked up, answered."""

    server: AnnotationServer
    static = STATIC
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "sc3d", ""
    timeout = 60  # s that a connection may stay silent

    def do_GET(self) -> None:
        self._respond(self._get)

    def do_POST(self) -> None:
        self._respond(self._post)

    def _respond(self, answer: Callable[[str], Answer]) -> None:
        try:
            self._check_origin()
            found, status = answer(urlsplit(self.path).path), HTTPStatus.OK
        except Refusal as refusal:
            found, status = _to_json({"error": str(refusal)}), refusal.status
        except (BusyError, StaleError) as error:
            found, status = _to_json({"error": str(error)}), HTTPStatus.CONFLICT
        except InputError as error:
            found, status = _to_json({"error": str(error)}), HTTPStatus.UNPROCESSABLE_ENTITY
        except Exception:  # the page must hear of it; the traceback goes to the log
            logger.exception("%s %s failed", self.command, self.path)
            found, status = (
                _to_json({"error": "something went wrong: see the terminal"}),
                HTTPStatus.INTERNAL_SERVER_ERROR,
            )
        self._send(status, found)

    def _get(self, path: str) -> Answer:
        session = self.server.session
        if path in self.static:
            return self._static(*self.static[path])
        if path == "/scene":
            return _to_json(session.describe())
        kind, stem = self._split(path, ("photo", "strokes"))
        return (
            Answer(session.photo(stem), "image/jpeg")
            if kind == "photo"
            else _to_json({"shapes": session.read(stem)})
        )

    def _post(self, path: str) -> Answer:
        self._check_token()
        content = self._body()
        kind, stem = self._split(path, ("strokes", "try"))
        if kind == "try":
            return Answer(self.server.session.try_out(stem), "image/png")
        return _to_json({"saved": self.server.session.save(stem, content)})

    def _check_origin(self) -> None:
        refusal = self.server.page.refusal(self.headers)
        if refusal is not None:
            raise Refusal(HTTPStatus.FORBIDDEN, refusal)

    def _check_token(self) -> None:
        if not self.server.page.is_own_origin(self.headers):
            raise Refusal(HTTPStatus.FORBIDDEN, "requests from other origins are refused")
        if not hmac.compare_digest(self.headers.get("X-Token", "").encode(), self.server.token.encode()):
            raise Refusal(HTTPStatus.FORBIDDEN, "the page is of an earlier start of the server: reload it")

    def _body(self) -> object:
        """The decoded JSON of a request."""
        if self.headers.get("Content-Type", "").partition(";")[0].strip() != "application/json":
            raise Refusal(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "JSON is expected")
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            raise Refusal(HTTPStatus.LENGTH_REQUIRED, "the length of the request is missing")
        if len(length) > len(str(LARGEST_BODY)) or int(length) > LARGEST_BODY:
            raise Refusal(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"more than {LARGEST_BODY >> 20} MB of strokes"
            )
        try:
            return json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            raise Refusal(HTTPStatus.BAD_REQUEST, "the request is not valid JSON") from None

    def _split(self, path: str, kinds: tuple[str, ...]) -> tuple[str, str]:
        """`/<kind>/<photo stem>` of a photo of the scene."""
        kind, separator, stem = path.removeprefix("/").partition("/")
        if kind not in kinds or unquote(stem) not in self.server.session.photos:
            raise Refusal(HTTPStatus.NOT_FOUND, "there is no such page or photo")
        return kind, unquote(stem)

    def _static(self, name: str, kind: str) -> Answer:
        text = files("sc3d.annotate").joinpath(name).read_text(encoding="utf-8")
        return Answer(text.replace("@TOKEN@", self.server.token).encode(), f"{kind}; charset=utf-8")

    def _send(self, status: HTTPStatus, answer: Answer) -> None:
        self.send_response(status)
        for name, value in (
            {"Content-Type": answer.kind, "Content-Length": str(len(answer.body))} | HEADERS
        ).items():
            self.send_header(name, value)
        if status != HTTPStatus.OK:
            self.send_header("Connection", "close")  # a refused body is still in the pipe
        self.end_headers()
        self.wfile.write(answer.body)

    def log_message(self, format: str, *values: object) -> None:
        logger.debug(format, *values)


class SuggestHandler(Handler):
    """The same for the page that asks."""

    static = {
        "/": ("suggest.html", "text/html"),
        "/suggest.js": ("suggest.js", "text/javascript"),
        "/ask.js": STATIC["/ask.js"],
        "/style.css": STATIC["/style.css"],
    }

    def _get(self, path: str) -> Answer:
        return _to_json(self._suggestions.question()) if path == "/question" else super()._get(path)

    def _post(self, path: str) -> Answer:
        self._check_token()
        content = self._body()
        if not isinstance(content, dict):
            raise Refusal(HTTPStatus.BAD_REQUEST, "a JSON object is expected")
        if path == "/answer" and "class" in content:
            return _to_json(self._suggestions.answer(content.get("place"), content["class"]))
        if path == "/skip":
            return _to_json(self._suggestions.skip(content.get("place")))
        if path == "/undo":
            return _to_json(self._suggestions.undo())
        raise Refusal(HTTPStatus.NOT_FOUND, "there is no such page")

    @property
    def _suggestions(self) -> Suggestions:
        session = self.server.session
        if not isinstance(session, Suggestions):
            raise TypeError("this handler needs suggestions")
        return session


def _to_json(content: object) -> Answer:
    return Answer(json.dumps(content).encode(), "application/json")
