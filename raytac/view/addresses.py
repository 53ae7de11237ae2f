"""``PageAddresses``: the addresses that a page is served at, and which requests were meant for it."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Sequence

from raytac.errors import InputError

__all__ = ["PageAddresses"]

_LOCAL = ("127.0.0.1", "localhost", "[::1]")
_NAME = re.compile(r"(?!-)[a-z0-9_-]{1,63}(?<!-)(\.(?!-)[a-z0-9_-]{1,63}(?<!-))*", re.ASCII)
_DEFAULT_PORTS = (80, 443)
"""Browsers leave these out of an address."""


class PageAddresses:
    """Names and ports under which browsers may reach the page.

    Any web page that a user opens may send requests to this machine. In the header ``Origin`` a browser names the page that a request
    comes from, in ``Host`` the name that it asked for. The first shows another page; the second shows a foreign name whose owner has let
    it point to this machine (DNS rebinding).
    """

    def __init__(self, host: str, allow_hosts: Sequence[str] = ()) -> None:
        """Names for this machine, ``host``, and what is allowed beside.

        Args:
            host: address that is listened at.
            allow_hosts: further names, as ``NAME`` or ``NAME:PORT`` (the port that the browser sees, where something forwards it); an
                IPv6 address with a port stands in brackets.

        Raises:
            InputError: one that is no host name or address.
        """
        for name, value in (("host", host), *(("allow_host", value) for value in allow_hosts)):
            if not isinstance(value, str):
                raise InputError(name, value=value, rule="must be text")
        if isinstance(allow_hosts, str):
            raise InputError("allow_hosts", value=allow_hosts, rule="must be a list of names")
        self._pairs: set[tuple[str, int | None]] = {(name, None) for name in (*_LOCAL, _bracketed(host.lower()))}
        """Name and port; None is the port that is listened at."""
        self._pairs |= {_split(text) for text in allow_hosts}

    def refusal(self, hosts: Sequence[str], origins: Sequence[str], served_at: tuple[str, int]) -> str:
        """Why a request is refused; empty if it is for this page, and from it.

        Args:
            hosts: all values of the request's header ``Host``.
            origins: those of ``Origin``; a program that is no browser, and a browser that opens the page, send none.
            served_at: address and port of this machine that the request came in at. The address itself is one of the page's own, since
                no name was looked up to find it.
        """
        if len(hosts) != 1 or hosts[0].lower() not in self._own(served_at):
            return f"Host {', '.join(hosts)!r} is not an address of this page; open {self.url(served_at)}, or allow it by --allow-host"
        own = hosts[0].lower()
        if origins and (len(origins) != 1 or origins[0].lower() not in (f"http://{own}", f"https://{own}")):
            return f"Origin {', '.join(origins)!r} is another page"
        return ""

    def url(self, served_at: tuple[str, int]) -> str:
        """Address that opens the page."""
        return f"http://{_bracketed(served_at[0])}:{served_at[1]}"

    def _own(self, served_at: tuple[str, int]) -> set[str]:
        """Every value of ``Host`` that is this page's."""
        pairs = {(name, port or served_at[1]) for name, port in (*self._pairs, (_bracketed(served_at[0]), None))}
        return {f"{name}:{port}" for name, port in pairs} | {name for name, port in pairs if port in _DEFAULT_PORTS}


def _split(text: str) -> tuple[str, int | None]:
    """Name and port of ``NAME`` or ``NAME:PORT``, as browsers write them."""
    whole = _bracketed(text.strip().lower())  # the end of a bare IPv6 address is no port
    found = re.fullmatch(r"(\[[0-9a-f:.]+\]|[^\[\]:]+)(?::([0-9]{1,5}))?", whole)
    name = _bracketed(found[1].strip("[]")) if found else ""
    port = int(found[2]) if found and found[2] else None
    if not (name.startswith("[") or _NAME.fullmatch(name)) or port == 0 or (port or 0) > 65535:
        rule = "must be a host name or address, as in gpu3.example.org or gpu3.example.org:9000, without http:// and path"
        raise InputError("allow_host", value=text, rule=rule)
    return name, port


def _bracketed(name: str) -> str:
    """An IPv6 address as it stands in a URL; anything else as it is."""
    try:
        return f"[{ipaddress.IPv6Address(name).compressed}]"
    except ValueError:
        return name
