"""The bytes of TraCI: whatever comes is answered, refused, or no TraCI."""

from __future__ import annotations

import struct

import pytest
import traci
from hypothesis import given, settings
from hypothesis import strategies as st
from traci_pair import close_mirror, mirror

from merge_sumo.sumo.mirror import MirrorSimulation
from merge_sumo.vuts.traci import protocol as tp
from merge_sumo.vuts.traci.session import NotFiniteError, Session

SUMO: list[MirrorSimulation] = []
"""The one that answers; Hypothesis knows no fixtures."""


@pytest.fixture(scope="module", autouse=True)
def _sumo(tmp_path_factory):
    SUMO[:] = [mirror(tmp_path_factory.mktemp("sumo"))]
    yield
    close_mirror()


def reference_commands() -> list[bytes]:
    """Return contents of messages that the stock package sends."""
    sent: list[bytes] = []
    kept = traci.connection.Connection.__new__(traci.connection.Connection)
    for form, values in (("d", (3.0,)), ("tdd", (2, 1.0, 2.0)), ("s", ("a",)), ("i", (5,))):
        payload = bytes((0x40,)) + tp.string("vut") + kept._pack(form, *values)
        sent.append(tp.command(bytes((0xC4,)) + payload))
    sent.append(tp.command(bytes((0x02,)) + struct.pack("!d", 0.0)))
    sent.append(tp.command(bytes((0xD4,)) + struct.pack("!dd", 0, 9) + tp.string("vut") + b"\1@"))
    sent.append(tp.command(b"\xa4\x68" + tp.string("vut") + tp.pack("d", 9.0)))
    on_road, point = ("ramp", 10.0, 0), (1.0, 2.0)
    places: list[tuple[bytes, str, tuple[object, ...]]] = [
        (b"\xab\x82" + tp.string(""), "trB", (2, on_road, 1)),
        (b"\xab\x82" + tp.string(""), "toBs", (3, point, 4, "ignoring")),
        (b"\xab\x83" + tp.string(""), "toou", (3, point, point, 1)),
        (b"\xa4\x83" + tp.string("vut"), "tru", (2, on_road, 1)),
    ]
    sent += [tp.command(head + kept._pack(form, *asked)) for head, form, asked in places]
    around = struct.pack("!dd", 0, 9) + tp.string("vut")
    sent += [tp.command(b"\x84" + around + kept._pack("uDuu", d, 50.0, 1, 1)) for d in (0xA3, 0xA4)]
    return sent


class TestTheProtocol:
    @settings(max_examples=300, deadline=None)
    @given(st.binary(max_size=200))
    def test_bytes_of_any_kind_are_commands_or_a_protocol_error(self, data):
        self.handle_all(data)

    @settings(max_examples=500, deadline=None)
    @given(st.data())
    def test_a_mutated_message_is_answered_refused_or_a_protocol_error(self, data):
        content = bytearray(b"".join(data.draw(st.lists(st.sampled_from(reference_commands())))))
        for _ in range(data.draw(st.integers(0, 5))):
            if content:
                content[data.draw(st.integers(0, len(content) - 1))] = data.draw(
                    st.integers(0, 255)
                )
        self.handle_all(bytes(content)[: data.draw(st.integers(0, 400))])

    def handle_all(self, data: bytes) -> None:
        try:
            commands = tp.commands_of(data)
        except tp.ProtocolError:
            return
        SUMO[0].load()
        session = Session(SUMO[0])
        session.enter({"pov": (-250.0, 30.0, 0.0), "vut": (-182.0, 18.0, 0.0)})
        for one in commands:
            try:
                answer = session.handle(one)
            except (tp.ProtocolError, NotFiniteError):
                continue
            # Status first, and nothing that is not a command of a stated length.
            first, *_ = tp.commands_of(answer)
            assert first.identifier == one.identifier
            assert answer[0] > 0, "clients read the length of a status as one byte"
        session.results()
        session.step()
        assert "vut" in session.sumo.at_m
