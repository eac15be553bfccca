"""Who may talk to a page that is served on this machine: nobody whom another web page sends, and nobody under
a foreign name.

A browser lets any page send requests to 127.0.0.1 and open WebSockets there, and a name that resolves to
127.0.0.1 makes a foreign page the server's own ("DNS rebinding"). Its headers tell: Host has the name that is
asked for, Origin and Sec-Fetch-Site the page that asks.
"""

from __future__ import annotations

import ipaddress
import platform
from dataclasses import dataclass
from typing import Protocol
from urllib.parse import SplitResult, urlsplit

LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})


class Headers(Protocol):
    """Of a request, with names of any case."""

    def get_all(self, name: str, /) -> list[str] | None: ...


@dataclass(frozen=True)
class LocalPage:
    """names: hosts under which the page may be asked for; any_address: bare IP addresses too, which no name
    server can turn; port: that must be asked for, None = any, for tunnels lead there from other ports
    """

    names: frozenset[str] = LOOPBACK
    any_address: bool = False
    port: int | None = None

    @classmethod
    def at(cls, host: str) -> LocalPage:
        """For a server that listens at `host`: an address or name of this machine, or all of them."""
        if host in LOOPBACK:
            return cls()
        own = platform.node().lower()
        return cls(LOOPBACK | {host.lower(), own, own.partition(".")[0], f"{own}.local"}, any_address=True)

    def refusal(self, headers: Headers) -> str | None:
        """Why a request is refused, None = it is not."""
        host = _split(_only(headers, "Host"))
        if host is None or not self._is_mine(host):
            return "this page is served under the address that sc3d names, and no other"
        if headers.get_all("Origin") and not self.is_own_origin(headers):
            return "requests from other origins are refused"
        if (_only(headers, "Sec-Fetch-Site") or "none") not in ("same-origin", "none") and not _opens(
            headers
        ):
            return "requests from other sites are refused"
        return None

    def is_own_origin(self, headers: Headers) -> bool:
        """Whether a request comes, as its browser says, from a page of this very server."""
        origin, host = _only(headers, "Origin"), _only(headers, "Host")
        return origin is not None and origin.lower() in (f"http://{host}".lower(), f"https://{host}".lower())

    def _is_mine(self, host: SplitResult) -> bool:
        name = host.hostname or ""
        right = name in self.names or (self.any_address and _is_address(name))
        return right and self.port in (None, host.port)


def _opens(headers: Headers) -> bool:
    """Whether a person follows a link, which shows the page in a tab of its own."""
    return (_only(headers, "Sec-Fetch-Mode"), _only(headers, "Sec-Fetch-Dest")) == ("navigate", "document")


def _only(headers: Headers, name: str) -> str | None:
    """The value of a header, None where there is none or more than one."""
    found = headers.get_all(name) or []
    return found[0] if len(found) == 1 else None


def _split(host: str | None) -> SplitResult | None:
    """A Host header that is one."""
    if not host or set(host) & set("/?#@\\ "):
        return None
    try:
        found = urlsplit(f"//{host}")
        _ = found.port  # ValueError
    except ValueError:
        return None
    return found


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
