"""RTDE messages as bytes and back: pure functions, no sockets.

A package is `uint16 size, uint8 type, payload`, big-endian; the size counts
these three bytes, too. Both directions are here, for a client and a simulated
controller. Functions with an argument `version` differ between versions 1 and
2 of the protocol. Source: Universal Robots, "Real-Time Data Exchange (RTDE)
Guide".

Given any bytes, a decoder returns a value or raises `RtdeError`.
"""

from collections.abc import Iterable, Sequence
import dataclasses as dc
import enum
import struct

_HEADER = struct.Struct(">HB")
_LARGEST = 0xFFFF
_LARGEST_NAMES = 2048

# Format characters and number of values of a field.
_TYPES = {
    "BOOL": ("?", 1),
    "UINT8": ("B", 1),
    "UINT32": ("I", 1),
    "UINT64": ("Q", 1),
    "INT32": ("i", 1),
    "DOUBLE": ("d", 1),
    "VECTOR3D": ("3d", 3),
    "VECTOR6D": ("6d", 6),
    "VECTOR6INT32": ("6i", 6),
    "VECTOR6UINT32": ("6I", 6),
}

NOT_FOUND = "NOT_FOUND"
"""In place of a type: the controller does not know the name."""
IN_USE = "IN_USE"
"""In place of a type: another client controls the input."""

Value = bool | int | float | tuple
"""Value of a field: a number, or a tuple for vectors."""


class RtdeError(ValueError):
    """Bytes that are not an RTDE message, or values that fit into none."""


class PackageType(enum.IntEnum):
    """Type byte of a package; the same letter in both directions."""

    REQUEST_PROTOCOL_VERSION = ord("V")
    GET_URCONTROL_VERSION = ord("v")
    TEXT_MESSAGE = ord("M")
    DATA_PACKAGE = ord("U")
    SETUP_OUTPUTS = ord("O")
    SETUP_INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


class TextLevel(enum.IntEnum):
    """Severity of a text message."""

    EXCEPTION = 0
    ERROR = 1
    WARNING = 2
    INFO = 3


@dc.dataclass(frozen=True)
class TextMessage:
    """A line of text for people."""

    text: str
    source: str = ""
    level: int = TextLevel.INFO


@dc.dataclass(frozen=True)
class Setup:
    """A controller's answer to a recipe: its id and the fields' types."""

    recipe_id: int
    types: tuple[str, ...]


class PackageReader:
    """Cuts a stream of bytes into packages, however the bytes arrive."""

    def __init__(self):
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Takes received bytes and returns the packages that they complete.

        Args:
            data: The next bytes of the stream, any number of them.

        Returns:
            (type byte, payload) of each, in order; none after an impossible
            header: see `check`.
        """
        self._buffer += data
        packages = []
        start = 0
        while len(self._buffer) - start >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._buffer, start)
            if not _HEADER.size <= size <= len(self._buffer) - start:
                break
            payload = bytes(self._buffer[start + _HEADER.size : start + size])
            packages.append((kind, payload))
            start += size
        del self._buffer[:start]
        return packages

    def check(self) -> None:
        """Raises RtdeError if the stream cannot be followed any further.

        That is so if the next size is less than the header's own three bytes.
        The only remedy is to disconnect.
        """
        if len(self._buffer) >= _HEADER.size:
            size, _ = _HEADER.unpack_from(self._buffer)
            if size < _HEADER.size:
                raise RtdeError(f"package size {size}: must be at least 3")


def encode_package(kind: int, payload: bytes = b"") -> bytes:
    """Returns a package with its header."""
    size = _HEADER.size + len(payload)
    if size > _LARGEST:
        raise RtdeError(f"package of {size} bytes: at most {_LARGEST}")
    return _HEADER.pack(size, kind) + payload


def encode_version_request(version: int) -> bytes:
    """Returns the request to speak a version of the protocol, 1 or 2."""
    return encode_package(
        PackageType.REQUEST_PROTOCOL_VERSION, struct.pack(">H", version)
    )


def decode_version_request(payload: bytes) -> int:
    """Returns which version a client wants to speak."""
    return _unpack(">H", payload, "version request")[0]


def encode_accepted(kind: int, accepted: bool) -> bytes:
    """Returns the answer to a version request, a start or a pause."""
    return encode_package(kind, struct.pack(">B", accepted))


def decode_accepted(payload: bytes) -> bool:
    """Returns whether a version request, a start or a pause was accepted."""
    return _unpack(">B", payload, "answer")[0] != 0


def encode_controller_version(version: tuple[int, int, int, int]) -> bytes:
    """Returns the controller's version: major, minor, bugfix, build."""
    return encode_package(
        PackageType.GET_URCONTROL_VERSION, struct.pack(">4I", *version)
    )


def decode_controller_version(payload: bytes) -> tuple[int, int, int, int]:
    """Returns major, minor, bugfix and build number."""
    return _unpack(">4I", payload, "controller version")


def encode_output_setup(
    names: Sequence[str], *, frequency: float, version: int = 2
) -> bytes:
    """Returns the request for a stream of outputs.

    Args:
        names: Of the fields, in the desired order.
        frequency: Packages per second; version 1 cannot choose.
        version: Of the protocol.
    """
    head = struct.pack(">d", frequency) if version >= 2 else b""
    return encode_package(
        PackageType.SETUP_OUTPUTS, head + _encode_names(names)
    )


def decode_output_setup(
    payload: bytes, *, version: int = 2
) -> tuple[float | None, tuple[str, ...]]:
    """Returns the requested frequency (None in version 1) and names."""
    if version < 2:
        return None, _decode_request(payload)
    if len(payload) < 8:
        raise RtdeError("output setup: too short")
    return struct.unpack_from(">d", payload)[0], _decode_request(payload[8:])


def encode_output_setup_reply(setup: Setup, *, version: int = 2) -> bytes:
    """Returns the answer to an output setup."""
    head = bytes([setup.recipe_id]) if version >= 2 else b""
    return encode_package(
        PackageType.SETUP_OUTPUTS, head + ",".join(setup.types).encode("ascii")
    )


def decode_output_setup_reply(payload: bytes, *, version: int = 2) -> Setup:
    """Returns recipe id (0 in version 1, which has none) and types."""
    if version < 2:
        return Setup(0, _decode_names(payload))
    return decode_input_setup_reply(payload)


def encode_input_setup(names: Sequence[str]) -> bytes:
    """Returns the request to control inputs."""
    return encode_package(PackageType.SETUP_INPUTS, _encode_names(names))


def decode_input_setup(payload: bytes) -> tuple[str, ...]:
    """Returns the names of the inputs that a client wants to control."""
    return _decode_request(payload)


def encode_input_setup_reply(setup: Setup) -> bytes:
    """Returns the answer to an input setup, the same in both versions."""
    return encode_package(
        PackageType.SETUP_INPUTS,
        bytes([setup.recipe_id]) + ",".join(setup.types).encode("ascii"),
    )


def decode_input_setup_reply(payload: bytes) -> Setup:
    """Returns recipe id and types."""
    if not payload:
        raise RtdeError("setup reply: empty")
    return Setup(payload[0], _decode_names(payload[1:]))


def encode_text(
    message: TextMessage, *, version: int = 2, from_controller: bool = True
) -> bytes:
    """Returns a text message; a text that is too long is cut.

    In version 1 a controller's message has no source and no lengths.
    """
    text = message.text.encode("ascii", "replace")
    if version < 2 and from_controller:
        payload = bytes([message.level]) + text
    else:
        text = text[:255]
        source = message.source.encode("ascii", "replace")[:255]
        payload = (
            bytes([len(text)])
            + text
            + bytes([len(source)])
            + source
            + bytes([message.level])
        )
    return encode_package(PackageType.TEXT_MESSAGE, payload)


def decode_text(
    payload: bytes, *, version: int = 2, from_controller: bool = True
) -> TextMessage:
    """Returns a text message."""
    if not payload:
        raise RtdeError("text message: empty")
    if version < 2 and from_controller:
        return TextMessage(_decode_text(payload[1:]), "", payload[0])
    end = 1 + payload[0]
    if len(payload) <= end:
        raise RtdeError("text message: too short")
    source_end = end + 1 + payload[end]
    if len(payload) != source_end + 1:
        raise RtdeError("text message: its lengths do not add up")
    return TextMessage(
        _decode_text(payload[1:end]),
        _decode_text(payload[end + 1 : source_end]),
        payload[source_end],
    )


class Recipe:
    """An agreed list of fields: packs values into packages and back.

    Args:
        names: Of the fields.
        types: As named by the controller.
        recipe_id: The controller's number for this recipe.

    Raises:
        RtdeError: The lists differ in length or a type is unknown.
    """

    def __init__(
        self, names: Sequence[str], types: Sequence[str], recipe_id: int
    ):
        if len(names) != len(types):
            raise RtdeError(f"{len(names)} names, but {len(types)} types")
        unknown = [kind for kind in types if kind not in _TYPES]
        if unknown:
            raise RtdeError(f"unknown type: {', '.join(unknown)}")
        self.names = tuple(names)
        self.types = tuple(types)
        self.recipe_id = recipe_id
        self._values = struct.Struct(
            ">" + "".join(_TYPES[kind][0] for kind in types)
        )
        self._counts = tuple(_TYPES[kind][1] for kind in types)

    @property
    def size(self) -> int:
        """Bytes of the values, without header and recipe id."""
        return self._values.size

    def encode(self, values: Iterable[Value], *, version: int = 2) -> bytes:
        """Returns a data package.

        Args:
            values: Of each field, vectors as sequences.
            version: 1 leaves out the recipe id, as a controller did then; a
                client's packages always have it.

        Raises:
            RtdeError: The values do not fit the recipe.
        """
        flat: list = []
        values = tuple(values)
        if len(values) != len(self._counts):
            raise RtdeError(
                f"{len(values)} values for {len(self._counts)} fields"
            )
        head = bytes([self.recipe_id]) if version >= 2 else b""
        try:
            for value, count in zip(values, self._counts, strict=True):
                if count == 1:
                    flat.append(value)
                else:
                    flat.extend(value)  # type: ignore[arg-type]  # Raises.
            payload = head + self._values.pack(*flat)
        except (struct.error, TypeError) as error:
            raise RtdeError(f"data package: {error}") from None
        return encode_package(PackageType.DATA_PACKAGE, payload)

    def decode_flat(
        self, payload: bytes, *, version: int = 2, any_id: bool = False
    ) -> tuple:
        """Returns all numbers of a data package, without grouping vectors.

        Args:
            payload: Of a data package.
            version: 1 for a controller's packages that have no recipe id.
            any_id: Whether to accept packages of any recipe id.

        Raises:
            RtdeError: The package has a wrong recipe id or size.
        """
        start = 1 if version >= 2 else 0
        if len(payload) != start + self._values.size:
            raise RtdeError(
                f"data package of {len(payload)} bytes: "
                f"the recipe has {start + self._values.size}"
            )
        if start and payload[0] != self.recipe_id and not any_id:
            raise RtdeError(
                f"data package of recipe {payload[0]}: "
                f"expected {self.recipe_id}"
            )
        return self._values.unpack_from(payload, start)

    def decode(
        self, payload: bytes, *, version: int = 2, any_id: bool = False
    ) -> tuple[Value, ...]:
        """Returns the value of each field; arguments as for `decode_flat`."""
        flat = self.decode_flat(payload, version=version, any_id=any_id)
        values = []
        start = 0
        for count in self._counts:
            values.append(
                flat[start] if count == 1 else flat[start : start + count]
            )
            start += count
        return tuple(values)


def _unpack(layout: str, payload: bytes, what: str) -> tuple:
    if len(payload) != struct.calcsize(layout):
        raise RtdeError(
            f"{what} of {len(payload)} bytes: must be {struct.calcsize(layout)}"
        )
    return struct.unpack(layout, payload)


def _encode_names(names: Sequence[str]) -> bytes:
    """Returns names separated by commas, without one at the end."""
    try:
        payload = ",".join(names).encode("ascii")
    except UnicodeEncodeError as error:
        raise RtdeError(f"names: {error}") from None
    if not all(names) or any("," in name for name in names):
        raise RtdeError("names: must not be empty or have a comma")
    if len(payload) > _LARGEST_NAMES:
        raise RtdeError(
            f"names: {len(payload)} bytes, at most {_LARGEST_NAMES}"
        )
    return payload


def _decode_request(payload: bytes) -> tuple[str, ...]:
    """Returns the names requested by a client."""
    if len(payload) > _LARGEST_NAMES:
        raise RtdeError(
            f"names: {len(payload)} bytes, at most {_LARGEST_NAMES}"
        )
    return _decode_names(payload)


def _decode_names(payload: bytes) -> tuple[str, ...]:
    """Returns the names, without empty ones (a comma at the end)."""
    try:
        text = payload.decode("ascii")
    except UnicodeDecodeError:
        raise RtdeError("names: not ASCII") from None
    names = (name.strip() for name in text.split(","))
    return tuple(name for name in names if name)


def _decode_text(text: bytes) -> str:
    return text.decode("ascii", "replace")
