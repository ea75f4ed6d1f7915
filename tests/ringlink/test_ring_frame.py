import binascii
import random
import unittest

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

import tofssm_drake.ringlink.ring_frame as mut

# Written by hand from the table of the specification; as in docs/ring_link.md.
_PLAIN = bytes.fromhex(
    "54 52 02 01 08 00 07 00 40 e2 01 00 f4 01 00 03 18 d2 04 00 05 18 ff ff"
    "02 04 19 00 00 fe ff 30 28 00 03 00 18 2c 03 01 0c 00 00 00 fd ff ff 14"
    "05 07 09 17 1a 8e"
)
_COBS = bytes.fromhex(
    "06 54 52 02 01 08 02 07 04 40 e2 01 03 f4 01 05 03 18 d2 04 08 05 18 ff"
    "ff 02 04 19 01 05 fe ff 30 28 02 03 06 18 2c 03 01 0c 01 01 0b fd ff ff"
    "14 05 07 09 17 1a 8e 00"
)


def make_example():
    return mut.RingFrame(
        ring=1,
        sequence=7,
        time_us=123456,
        mm=np.array([500, 1234, 65535, 0, 40, 812, 0, 1300]),
        status=np.array([0, 0, 2, 254, 3, 1, 253, 7]),
        age_ms=np.array([3, 5, 4, 255, 0, 12, 255, 9]),
        period_ms=np.array([24, 24, 25, 48, 24, 0, 255, 23]),
    )


@st.composite
def frames(draw):
    n = draw(st.integers(1, mut.MOST_SENSORS))

    def numbers(high):
        return np.array(
            draw(st.lists(st.integers(0, high), min_size=n, max_size=n))
        )

    return mut.RingFrame(
        ring=draw(st.integers(0, 255)),
        flags=draw(st.sampled_from([0, 1, 2, 3, 4, 7, 0x80, 0x87])),
        sequence=draw(st.integers(0, 0xFFFF)),
        time_us=draw(st.integers(0, 0xFFFFFFFF)),
        mm=numbers(0xFFFF),
        status=numbers(0xFF),
        age_ms=numbers(0xFF),
        period_ms=numbers(0xFF),
    )


def crc_bit_by_bit(data):
    """CRC-16/CCITT-FALSE from its definition, without a table."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ (0x1021 if crc & 0x8000 else 0)
            crc &= 0xFFFF
    return crc


class TestFrame(unittest.TestCase):
    def test_known_answer(self):
        self.assertEqual(mut.encode_frame(make_example()), _PLAIN)
        self.assertEqual(mut.encode_serial(make_example()), _COBS)
        frame = mut.decode_frame(_PLAIN)
        self.assertEqual((frame.ring, frame.flags), (1, 0))
        self.assertEqual((frame.sequence, frame.time_us), (7, 123456))
        for name in ("mm", "status", "age_ms", "period_ms"):
            np.testing.assert_array_equal(
                getattr(frame, name), getattr(make_example(), name)
            )

    def test_crc(self):
        self.assertEqual(mut.calc_crc(b"123456789"), 0x29B1)
        for size in (0, 1, 52, 92):
            data = random.Random(size).randbytes(size)
            self.assertEqual(mut.calc_crc(data), crc_bit_by_bit(data))

    def test_sizes(self):
        self.assertEqual(mut.calc_frame_size(8), 54)
        self.assertEqual(mut.calc_frame_size(16), 94)

    @given(frames())
    def test_round_trip(self, frame):
        data = mut.encode_frame(frame)
        self.assertEqual(len(data), mut.calc_frame_size(len(frame.mm)))
        again = mut.decode_frame(data)
        self.assertEqual(mut.encode_frame(again), data)
        for name in ("ring", "flags", "sequence", "time_us"):
            self.assertEqual(getattr(again, name), getattr(frame, name))
        for name in ("mm", "status", "age_ms", "period_ms"):
            np.testing.assert_array_equal(
                getattr(again, name), getattr(frame, name)
            )

    def check_wrong(self, kind, data):
        with self.assertRaises(mut.FrameError) as caught:
            mut.decode_frame(data)
        self.assertEqual(caught.exception.kind, kind)

    def change(self, offset, value):
        """The example with a byte changed and a CRC that is right."""
        data = bytearray(_PLAIN[:-2])
        data[offset] = value
        crc = binascii.crc_hqx(data, 0xFFFF)
        return bytes(data) + crc.to_bytes(2, "little")

    def test_reports_what_is_wrong(self):
        self.assertEqual(self.change(0, ord("T")), _PLAIN)
        self.check_wrong("magic", self.change(0, ord("t")))
        self.check_wrong("magic", self.change(1, 0))
        self.check_wrong("version", self.change(2, 1))
        for n in (0, 7, 9, 16, 255):
            self.check_wrong("length", self.change(4, n))
        for flags in (0x08, 0x10, 0x20, 0x40):
            self.check_wrong("flags", self.change(5, flags))
        for size in (0, 1, 11, 12, 46, 53):
            self.check_wrong("length", _PLAIN[:size])
        self.check_wrong("length", _PLAIN + b"\0")
        self.check_wrong("crc", _PLAIN[:-1] + b"\x8f")
        # Big-endian.
        self.check_wrong("crc", _PLAIN[:-2] + _PLAIN[:-3:-1])

    def test_rejects_what_does_not_fit(self):
        import dataclasses as dc

        frame = make_example()
        for change in (
            {"ring": 256},
            {"ring": -1},
            {"flags": 8},
            {"sequence": 0x10000},
            {"time_us": 1 << 32},
            {"mm": np.arange(7)},
            {"mm": np.full(8, 0x10000)},
            {"mm": np.full(8, -1)},
            {"mm": np.full(8, np.nan)},
            {"status": np.full(8, 256)},
            {"age_ms": np.full(9, 0)},
            {"period_ms": np.full(8, 256)},
        ):
            with self.subTest(change=change), self.assertRaises(ValueError):
                mut.encode_frame(dc.replace(frame, **change))


class TestFrameStream(unittest.TestCase):
    @given(st.binary(max_size=400))
    def test_any_bytes_give_frames_or_known_errors(self, data):
        stream = mut.FrameStream()
        stream.push(b"\0" + data + b"\0")
        self.assertLessEqual(set(stream.errors), {"cobs", "length", "magic"})
        # The next frame is found whatever came before.
        self.assertEqual(len(stream.push(_COBS)), 1)

    def test_any_pieces(self):
        line = _COBS * 5
        for size in (1, 2, 7, 47, 48, 49, 240):
            stream = mut.FrameStream()
            frames = []
            for i in range(0, len(line), size):
                frames += stream.push(line[i : i + size])
            self.assertEqual(len(frames), 5)
            self.assertEqual(stream.errors, {})
            for frame in frames:
                self.assertEqual(mut.encode_frame(frame), _PLAIN)

    def test_starts_in_the_middle(self):
        for cut in range(len(_COBS)):
            stream = mut.FrameStream()
            frames = stream.push(_COBS[cut:] + _COBS)
            self.assertEqual(len(frames), 2 if cut == 0 else 1)
            self.assertEqual(stream.errors, {})

    def test_goes_on_after_damage(self):
        bad = bytearray(_COBS)
        bad[20] ^= 0x10
        stream = mut.FrameStream()
        frames = stream.push(_COBS + bytes(bad) + _COBS)
        self.assertEqual(len(frames), 2)
        self.assertEqual(stream.errors, {"crc": 1})

    def test_a_lost_delimiter_costs_two_frames(self):
        stream = mut.FrameStream()
        frames = stream.push(_COBS + _COBS[:-1] + _COBS + _COBS)
        self.assertEqual(len(frames), 2)
        self.assertEqual(sum(stream.errors.values()), 1)

    def test_garbage_without_end_takes_no_memory(self):
        stream = mut.FrameStream()
        stream.push(b"\0")
        for _ in range(1000):
            self.assertEqual(stream.push(b"\x55" * 1000), [])
        self.assertLess(len(stream._rest), 400)
        self.assertEqual(stream.push(b"\0"), [])
        self.assertEqual(stream.errors, {"length": 1})
        self.assertEqual(len(stream.push(_COBS)), 1)


def mutate(generator, data):
    """Damages bytes as lines do: flips, losses, repeats, bursts, garbage."""
    data = bytearray(data)
    for _ in range(generator.randint(1, 3)):
        kind = generator.randrange(8)
        i = generator.randrange(len(data)) if data else 0
        if not data or kind == 0:
            data[i:i] = generator.randbytes(generator.randint(1, 3))
        elif kind in (1, 2):
            data[i] ^= 1 << generator.randrange(8)
        elif kind == 3:
            del data[i : i + generator.randint(1, 3)]
        elif kind == 4:
            data[i : i + 2] = generator.randbytes(2)
        elif kind == 5:
            j = i + generator.randint(1, 20)
            data[j:j] = data[i:j]
        elif kind == 6:
            data[i] = 0
        else:
            del data[i:]
    return bytes(data)


def identify(frame):
    """Returns all values that a sender put into a frame."""
    return (
        *(frame.ring, frame.flags, frame.sequence, frame.time_us),
        *(
            np.asarray(values, int).tobytes()
            for values in (
                frame.mm,
                frame.status,
                frame.age_ms,
                frame.period_ms,
            )
        ),
    )


class TestFuzz(unittest.TestCase):
    """Mutated streams: nothing escapes, nothing wrong is accepted."""

    @classmethod
    def setUpClass(cls):
        generator = random.Random(1)
        cls.lines = []
        for i in range(64):
            n = (8, mut.MOST_SENSORS)[i % 2]
            frame = mut.RingFrame(
                ring=i % 3,
                sequence=generator.randrange(1 << 16),
                time_us=generator.randrange(1 << 32),
                mm=np.array([generator.randrange(1400) for _ in range(n)]),
                status=np.array([generator.choice((0, 2)) for _ in range(n)]),
                age_ms=np.array([generator.randrange(6) for _ in range(n)]),
                period_ms=np.full(n, 24),
            )
            cls.lines.append(
                (
                    identify(frame),
                    mut.encode_frame(frame),
                    mut.encode_serial(frame),
                )
            )

    def test_serial(self):
        self.check_serial(10_000)

    @pytest.mark.long
    def test_serial_many_times(self):
        self.check_serial(70_000)

    def check_serial(self, streams):
        generator = random.Random(2)
        resynchronised = 0
        for _ in range(streams):
            (sent, _, line), (after, _, next_line) = generator.choices(
                self.lines, k=2
            )
            stream = mut.FrameStream()
            stream.push(b"\0")
            frames = stream.push(mutate(generator, line) + b"\0" + next_line)
            for frame in frames[:-1]:
                self.assertEqual(identify(frame), sent)
            self.assertEqual(identify(frames[-1]), after)
            resynchronised += len(frames) == 1
        self.assertGreater(resynchronised, streams * 6 / 7)

    def test_datagrams(self):
        generator = random.Random(3)
        rejected = 0
        for _ in range(30_000):
            sent, plain, _ = generator.choice(self.lines)
            try:
                frame = mut.decode_frame(mutate(generator, plain))
            except mut.FrameError:
                rejected += 1
            else:
                self.assertEqual(identify(frame), sent)
        self.assertGreater(rejected, 29_000)

    @given(st.lists(st.binary(max_size=120), max_size=6))
    def test_any_bytes(self, pieces):
        stream = mut.FrameStream()
        for piece in pieces:
            stream.push(piece)


class TestUnwrap(unittest.TestCase):
    def test_forward_and_back_over_the_end(self):
        self.assertEqual(mut.unwrap(2, 65534, 16), 65538)
        self.assertEqual(mut.unwrap(65534, 65538, 16), 65534)
        self.assertEqual(mut.unwrap(5, 3 * 65536 + 7, 16), 3 * 65536 + 5)

    @given(
        st.integers(0, 1 << 60),
        st.integers(-(1 << 31), (1 << 31) - 1),
    )
    def test_is_exact_within_half_the_range(self, near, step):
        self.assertEqual(
            mut.unwrap((near + step) % (1 << 32), near, 32), near + step
        )


if __name__ == "__main__":
    unittest.main()
