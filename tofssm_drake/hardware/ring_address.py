"""Where a ring's frames come from or go to, as a user writes it."""

import dataclasses as dc
import ipaddress
from urllib.parse import parse_qs, urlsplit

from tofssm_drake.errors import UserError, require

_FORMS = "udp://ADDRESS:PORT[?from=ADDRESS] or serial:///dev/NAME[?baud=RATE]"
_DEFAULT_BAUD = 921600


@dc.dataclass(frozen=True, kw_only=True)
class UdpAddress:
    """A port on one of this machine's interfaces."""

    host: str
    """IPv4 address of the interface."""
    port: int
    senders: tuple[str, ...]
    """IPv4 addresses whose datagrams count; all others are foreign."""

    def __str__(self) -> str:
        return f"udp://{self.host}:{self.port}"


@dc.dataclass(frozen=True, kw_only=True)
class SerialAddress:
    """A serial line or what looks like one."""

    path: str
    baud: int = _DEFAULT_BAUD

    def __str__(self) -> str:
        return f"serial://{self.path}"


RingAddress = UdpAddress | SerialAddress


def parse_ring_address(
    text: str, *, where: str = "--rings", allow_remote: bool = False
) -> RingAddress:
    """Reads an address.

    `udp://192.168.1.10:5005?from=192.168.1.20` binds one interface and takes
    datagrams from the named sender (or several, separated by commas); without
    `from` only from the same address, which is this machine itself.
    `serial:///dev/ttyACM0?baud=115200` is a serial line, by default at 921600
    baud.

    Args:
        text: What the user wrote.
        where: Where the user wrote it.
        allow_remote: Whether every interface (0.0.0.0) may be bound.

    Raises:
        UserError: It is no such address.
    """
    try:
        parts = urlsplit(text)
        port = parts.port
        options = parse_qs(
            parts.query,
            keep_blank_values=True,
            strict_parsing=bool(parts.query),
        )
    except ValueError as error:
        raise UserError(
            f"{where}: {text!r} is no address ({error}); use {_FORMS}"
        ) from None
    require(
        parts.scheme in ("udp", "serial") and not parts.fragment,
        f"{where}: {text!r} is no address; use {_FORMS}",
    )
    known = "from" if parts.scheme == "udp" else "baud"
    for name, values in options.items():
        require(
            name == known and len(values) == 1,
            f"{where}: {text!r}: option {name!r} is unknown or there twice; "
            f"{parts.scheme} has {known!r}",
        )
    if parts.scheme == "udp":
        return _parse_udp(text, where, allow_remote, parts, port, options)
    require(
        not parts.netloc and parts.path.startswith("/") and parts.path != "/",
        f"{where}: {text!r} names no device; use {_FORMS}",
    )
    (baud,) = options.get("baud", [str(_DEFAULT_BAUD)])
    require(
        baud.isascii() and baud.isdigit() and 0 < int(baud) <= 10_000_000,
        f"{where}: {text!r}: baud {baud!r} must be a whole number above 0",
    )
    return SerialAddress(path=parts.path, baud=int(baud))


def _parse_udp(text, where, allow_remote, parts, port, options):
    require(
        port is not None and port > 0 and parts.path in ("", "/"),
        f"{where}: {text!r} names no port from 1 to 65535; use {_FORMS}",
    )
    require(
        parts.username is None and parts.password is None,
        f"{where}: {text!r}: a datagram has no user; use {_FORMS}",
    )
    host = _parse_ip(text, where, parts.hostname or "")
    require(
        allow_remote or host != "0.0.0.0",
        f"{where}: {text!r} would listen on every interface; name the "
        "address of one, or add --allow-remote",
    )
    require(
        not ipaddress.IPv4Address(host).is_multicast,
        f"{where}: {text!r}: rings send to one machine, not to a group",
    )
    if "from" in options:
        senders = tuple(
            _parse_ip(text, where, sender)
            for sender in options["from"][0].split(",")
        )
    else:
        require(
            host != "0.0.0.0",
            f"{where}: {text!r} must name who sends: add ?from=ADDRESS",
        )
        senders = (host,)
    return UdpAddress(host=host, port=port, senders=senders)


def _parse_ip(text, where, host):
    if host == "localhost":
        return "127.0.0.1"
    try:
        return str(ipaddress.IPv4Address(host))
    except ValueError:
        raise UserError(
            f"{where}: {text!r}: {host!r} is no IPv4 address such as 127.0.0.1"
        ) from None
