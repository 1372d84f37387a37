"""A TraCI client of a few lines that can misbehave; as a program: raw_traci.py PORT [MISDEED].

It knows three commands of the protocol, so that it starts at once and can be wrong on purpose.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
from contextlib import suppress

STEP, CLOSE, GET_VEHICLE, SET_VEHICLE = 0x02, 0x7F, 0xA4, 0xC4
SPEED = 0x40


def text(value: str) -> bytes:
    return struct.pack("!i", len(value)) + value.encode()


def command(identifier: int, payload: bytes = b"") -> bytes:
    return struct.pack("!BiB", 0, len(payload) + 6, identifier) + payload


RETRY_S = 0.02


class GoneError(Exception):
    """The server closed the connection."""


class Client:
    def __init__(self, port: int) -> None:
        for _ in range(500):
            with suppress(OSError):
                self.socket = socket.create_connection(("127.0.0.1", port), timeout=10.0)
                return
            time.sleep(RETRY_S)
        raise GoneError

    def send(self, *commands: bytes) -> None:
        content = b"".join(commands)
        try:
            self.socket.sendall(struct.pack("!i", len(content) + 4) + content)
        except OSError as error:
            raise GoneError from error

    def read(self, count: int) -> bytes:
        data, part = b"", b""
        while len(data) < count:
            with suppress(OSError):
                part = self.socket.recv(count - len(data))
            if not part:
                raise GoneError
            data, part = data + part, b""
        return data

    def ask(self, *commands: bytes) -> bytes:
        self.send(*commands)
        return self.read(struct.unpack("!i", self.read(4))[0] - 4)

    def step(self, target_s: float = 0.0) -> None:
        self.ask(command(STEP, struct.pack("!d", target_s)))

    def speed(self) -> float | None:
        """Return the speed of the VUT, or None when it is not there."""
        answer = self.ask(command(GET_VEHICLE, bytes((SPEED,)) + text("vut")))
        return struct.unpack("!d", answer[-8:])[0] if answer[2] == 0 else None

    def set_speed(self, value: float) -> None:
        typed = struct.pack("!Bd", 0x0B, value)
        self.ask(command(SET_VEHICLE, bytes((SPEED,)) + text("vut") + typed))

    def drive(self, steps: int) -> None:
        """Make steps on the level-0 profile."""
        for _ in range(steps):
            self.step()
            v = self.speed()
            if v is not None:
                self.set_speed(min(v + 0.1, max(v, 28.0)))


MISDEEDS = {
    "nan": lambda c: (c.set_speed(float("nan")), c.step()),
    "says goodbye": lambda c: (c.ask(command(CLOSE)), c.socket.close()),
    "half a message": lambda c: (c.socket.sendall(b"\0\0\0\x20\x05"), c.read(1)),
    "a huge message": lambda c: (c.socket.sendall(b"\x7f\xff\xff\xff"), c.read(1)),
    "crashes": lambda c: 1 / 0,
}
"""What a client may do wrong in an episode."""


def main(port: int, misdeed: str | None = None) -> None:
    client = Client(port)
    if misdeed is None:
        while True:
            client.drive(1)
    client.drive(4)
    MISDEEDS[misdeed](client)


if __name__ == "__main__":
    with suppress(GoneError):
        main(int(sys.argv[1]), *sys.argv[2:])
