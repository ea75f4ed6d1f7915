"""Where a ring's frames come from or go to, as a user writes it."""

from collections.abc import Sequence
import dataclasses as dc
import fcntl
import ipaddress
import socket
import struct
from urllib.parse import parse_qs, urlsplit

from tofssm_drake.errors import UserError, require

_FORMS = "udp://ADDRESS:PORT[?from=ADDRESS] or serial:///dev/NAME[?baud=RATE]"
_DEFAULT_BAUD = 921600
# Linux's request for an interface's IPv4 address.
_SIOCGIFADDR = 0x8915
# The same for its broadcast address.
_SIOCGIFBRDADDR = 0x8919


@dc.dataclass(frozen=True, kw_only=True)
class UdpAddress:
    """A port on one of this machine's interfaces."""

    host: str
    """IPv4 address of the interface."""
    port: int
    senders: tuple[str, ...]
    """IPv4 addresses whose datagrams count; all others are foreign."""
    interface: str = ""
    """Name of the only interface that counts; empty: any with that address."""

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
    `from` only from the same address, which is this machine itself. The
    interface may also be given by name: `udp://eth0:5005?from=...`.
    `serial:///dev/ttyACM0?baud=115200` is a serial line, by default at 921600
    baud.

    Args:
        text: What the user wrote.
        where: Where the user wrote it.
        allow_remote: Whether every interface (0.0.0.0) may be bound.

    Raises:
        UserError: It is not such an address.
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
            f"{where}: {text!r} is not an address ({error}); use {_FORMS}"
        ) from None
    require(
        parts.scheme in ("udp", "serial") and not parts.fragment,
        f"{where}: {text!r} is not an address; use {_FORMS}",
    )
    known = "from" if parts.scheme == "udp" else "baud"
    for name, values in options.items():
        require(
            name == known and len(values) == 1,
            f"{where}: {text!r}: option {name!r} is unknown or given twice; "
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
    # As written: interface names are case-sensitive.
    name = parts.netloc.rpartition(":")[0]
    interface = name if name in list_interfaces() else ""
    if interface:
        host = find_interface_address(interface)
        require(
            bool(host),
            f"{where}: {text!r}: interface {interface!r} has no IPv4 address",
        )
    else:
        host = _parse_ip(text, where, name, is_ours=True)
    require(
        allow_remote or host != "0.0.0.0",
        f"{where}: {text!r} would listen on every interface; name the "
        "address of one, or add --allow-remote",
    )
    require(
        not ipaddress.IPv4Address(host).is_multicast,
        f"{where}: {text!r}: rings send to one machine, not to a group",
    )
    require(
        not _is_broadcast(host),
        f"{where}: {text!r}: {host} is for broadcasts, rings send to one "
        "machine; name the address of an interface",
    )
    if "from" in options:
        senders = tuple(
            _parse_ip(text, where, sender)
            for sender in options["from"][0].split(",")
        )
    else:
        # What a machine sends to itself arrives on no other interface.
        require(
            host != "0.0.0.0"
            and (not interface or ipaddress.IPv4Address(host).is_loopback),
            f"{where}: {text!r} must name the sender: add ?from=ADDRESS",
        )
        senders = (host,)
    return UdpAddress(
        host=host, port=port, senders=senders, interface=interface
    )


def list_interfaces() -> list[str]:
    """Returns the names of this machine's network interfaces."""
    return [name for _, name in socket.if_nameindex()]


def find_interface_address(name: str) -> str:
    """Returns the IPv4 address of an interface; "" if it has none."""
    return _ask_interface(name, _SIOCGIFADDR)


def find_broadcast_address(name: str) -> str:
    """Returns an interface's broadcast address; "" if it has none."""
    return _ask_interface(name, _SIOCGIFBRDADDR)


def require_distinct(
    addresses: Sequence[RingAddress], where: str = "--rings"
) -> None:
    """Raises UserError if a port or line is given twice.

    Args:
        addresses: All addresses to listen on.
        where: Where the user wrote them.
    """
    texts = [str(address) for address in addresses]
    for text in texts:
        require(
            texts.count(text) == 1,
            f"{where}: {text} is given twice; for several senders on "
            "one port use ?from=ADDRESS,ADDRESS",
        )


def _is_broadcast(host):
    """Returns whether datagrams to it go to more than one machine."""
    if host == "0.0.0.0":
        # Every interface; reported by one without broadcasts.
        return False
    return host in ("255.255.255.255", "127.255.255.255") or host in map(
        find_broadcast_address, list_interfaces()
    )


def _ask_interface(name, what):
    request = struct.pack("256s", name.encode())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            answer = fcntl.ioctl(probe.fileno(), what, request)
        except OSError:
            return ""
    return socket.inet_ntoa(answer[20:24])


def _parse_ip(text, where, host, *, is_ours=False):
    if host == "localhost":
        return "127.0.0.1"
    try:
        return str(ipaddress.IPv4Address(host))
    except ValueError:
        ours = ""
        if is_ours:
            names = ", ".join(list_interfaces())
            ours = f", nor an interface of this machine ({names})"
        raise UserError(
            f"{where}: {text!r}: {host!r} is not an IPv4 address such as "
            f"127.0.0.1{ours}"
        ) from None
