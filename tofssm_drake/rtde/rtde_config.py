"""Where a robot's controller is and how to talk to it."""

import dataclasses as dc

from tofssm_drake.errors import require


@dc.dataclass(kw_only=True)
class RtdeConfig:
    """Where the robot is and how to talk to it."""

    # Name or address of the robot's controller, and its RTDE port.
    host: str = "127.0.0.1"
    port: int = 30004

    # Packages per second; 0: as many as the controller makes (125 before
    # software 5, then 500).
    frequency: float = 0.0

    # Claim speed slider and heartbeat; if False, nothing is written.
    write: bool = True

    # input_int_register of the heartbeat (24 to 47 are for external clients)
    # and output_int_register in which the robot's program counts products.
    heartbeat_register: int = 24
    products_register: int = 24

    # Accept servers that answer a setup with names instead of types, or number
    # their packages differently than announced, or know few fields.
    lenient: bool = False

    # Longest time to connect and for each answer, s.
    connect_timeout: float = 2.0
    reply_timeout: float = 2.0

    # Without a package for this long the connection counts as lost, s.
    stream_timeout: float = 0.1

    # If the robot's clock jumps backwards, or forwards by more than this, s, a
    # new session begins; also if it gains 0.25 s on the host's at once.
    clock_jump: float = 1.0

    # Pause before the next attempt, s: doubles from the first to the last.
    retry_first: float = 0.1
    retry_last: float = 2.0

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        require(bool(self.host), f"{where}.host: must not be empty")
        require(
            1 <= self.port <= 65535,
            f"{where}.port: must be from 1 to 65535, got {self.port}",
        )
        require(
            self.frequency == 0 or 1 <= self.frequency <= 500,
            f"{where}.frequency: must be from 1 to 500 Hz or 0, "
            f"got {self.frequency:g}",
        )
        for name in ("heartbeat_register", "products_register"):
            require(
                0 <= getattr(self, name) <= 47,
                f"{where}.{name}: must be from 0 to 47, "
                f"got {getattr(self, name)}",
            )
        for name in (
            "connect_timeout",
            "reply_timeout",
            "stream_timeout",
            "clock_jump",
            "retry_first",
            "retry_last",
        ):
            require(
                0 < getattr(self, name) <= 60,
                f"{where}.{name}: must be more than 0 s and at most 60, "
                f"got {getattr(self, name):g}",
            )
        require(
            self.retry_first <= self.retry_last,
            f"{where}.retry_last: must not be less than retry_first, "
            f"{self.retry_first:g} s, got {self.retry_last:g}",
        )
