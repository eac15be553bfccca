"""Keeps other web pages from the viewer: viser itself answers whoever asks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from sc3d.errors import Sc3dError
from sc3d.io.local_page import LocalPage

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request


@contextmanager
def guarding(page: LocalPage) -> Iterator[None]:
    """WebSocket servers that start in the block answer only what `page` lets in, HTTP as well as WebSocket.

    viser has no option for it. It starts its server by `serve` of websockets, whose `process_request` sees
    every request first; that is where the check goes. Sc3dError, after the block, if no server was started
    that way.
    """
    from websockets.asyncio import server

    guarded = []

    class Guarded(server.serve):
        def __init__(
            self, *arguments: Any, process_request: Callable[..., Any] | None = None, **options: Any
        ) -> None:
            def check(connection: ServerConnection, request: Request) -> Any:
                refusal = page.refusal(request.headers)
                if refusal is not None:
                    return connection.respond(HTTPStatus.FORBIDDEN, f"{refusal}\n")
                return None if process_request is None else process_request(connection, request)

            super().__init__(*arguments, process_request=check, **options)
            guarded.append(self)

    original = server.serve
    server.serve = Guarded  # type: ignore[misc]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]
    if not guarded:
        raise Sc3dError(
            "other web pages could not be kept from this version of viser: pip install 'viser==1.1.1'"
        )
