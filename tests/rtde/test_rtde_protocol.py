import contextlib
import math
import struct
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np

from tofssm_drake.rtde.rtde_fields import (
    INPUT_TYPES,
    OUTPUT_TYPES,
)
import tofssm_drake.rtde.rtde_protocol as mut
from tofssm_drake.rtde.rtde_protocol import PackageType, RtdeError

_UINT32 = st.integers(0, 2**32 - 1)
_DOUBLE = st.floats(allow_nan=False)
_VALUES = {
    "BOOL": st.booleans(),
    "UINT8": st.integers(0, 255),
    "UINT32": _UINT32,
    "UINT64": st.integers(0, 2**64 - 1),
    "INT32": st.integers(-(2**31), 2**31 - 1),
    "DOUBLE": _DOUBLE,
    "VECTOR3D": st.tuples(*[_DOUBLE] * 3),
    "VECTOR6D": st.tuples(*[_DOUBLE] * 6),
    "VECTOR6INT32": st.tuples(*[st.integers(-(2**31), 2**31 - 1)] * 6),
    "VECTOR6UINT32": st.tuples(*[_UINT32] * 6),
}
_SIZES = {
    **{"BOOL": 1, "UINT8": 1, "UINT32": 4, "UINT64": 8, "INT32": 4},
    **{"DOUBLE": 8, "VECTOR3D": 24, "VECTOR6D": 48},
    **{"VECTOR6INT32": 24, "VECTOR6UINT32": 24},
}
_DECODERS = [
    mut.decode_version_request,
    mut.decode_accepted,
    mut.decode_controller_version,
    mut.decode_output_setup,
    lambda p: mut.decode_output_setup(p, version=1),
    mut.decode_output_setup_reply,
    lambda p: mut.decode_output_setup_reply(p, version=1),
    mut.decode_input_setup,
    mut.decode_input_setup_reply,
    mut.decode_text,
    lambda p: mut.decode_text(p, version=1),
    lambda p: mut.decode_text(p, version=1, from_controller=False),
]


def read_one(package):
    """Returns type and payload of exactly one package."""
    ((kind, payload),) = mut.PackageReader().feed(package)
    return kind, payload


class TestBytes(unittest.TestCase):
    """Messages as on the wire, written by hand."""

    def check(self, package, text):
        self.assertEqual(package, bytes.fromhex(text))

    def test_version(self):
        self.check(mut.encode_version_request(2), "0005 56 0002")
        self.check(
            mut.encode_accepted(PackageType.REQUEST_PROTOCOL_VERSION, True),
            "0004 56 01",
        )
        self.check(
            mut.encode_controller_version((3, 15, 8, 106)),
            "0013 76 00000003 0000000f 00000008 0000006a",
        )
        self.check(
            mut.encode_package(PackageType.GET_URCONTROL_VERSION), "0003 76"
        )

    def test_output_setup(self):
        names = ("timestamp", "actual_q")
        self.check(
            mut.encode_output_setup(names, frequency=125.0),
            "001d 4f 405f400000000000" + b"timestamp,actual_q".hex(),
        )
        self.check(
            mut.encode_output_setup(names, frequency=125.0, version=1),
            "0015 4f" + b"timestamp,actual_q".hex(),
        )
        setup = mut.Setup(1, ("DOUBLE", "VECTOR6D"))
        self.check(
            mut.encode_output_setup_reply(setup),
            "0013 4f 01 444f55424c452c564543544f523644",
        )
        self.check(
            mut.encode_output_setup_reply(setup, version=1),
            "0012 4f 444f55424c452c564543544f523644",
        )

    def test_input_setup_is_the_same_in_both_versions(self):
        self.check(mut.encode_input_setup(("a", "b")), "0006 49 612c62")
        self.check(
            mut.encode_input_setup_reply(mut.Setup(3, ("IN_USE", "DOUBLE"))),
            "0011 49 03" + b"IN_USE,DOUBLE".hex(),
        )

    def test_data(self):
        dut = mut.Recipe("abc", ("UINT32", "DOUBLE", "INT32"), 1)
        self.check(
            dut.encode((1, 0.25, 7)),
            "0014 55 01 00000001 3fd0000000000000 00000007",
        )
        # What ur_rtde's setSpeedSlider(0.25) writes.
        dut = mut.Recipe("abc", ("INT32", "UINT32", "DOUBLE"), 4)
        self.check(
            dut.encode((22, 1, 0.25)),
            "0014 55 04 00000016 00000001 3fd0000000000000",
        )
        self.check(
            dut.encode((22, 1, 0.25), version=1),
            "0013 55 00000016 00000001 3fd0000000000000",
        )

    def test_text(self):
        message = mut.TextMessage("hi", "me", 2)
        for version, from_controller, text in (
            (2, True, "0009 4d 02 6869 02 6d65 02"),
            (2, False, "0009 4d 02 6869 02 6d65 02"),
            (1, False, "0009 4d 02 6869 02 6d65 02"),
            (1, True, "0006 4d 02 6869"),
        ):
            with self.subTest(version=version, from_controller=from_controller):
                package = mut.encode_text(
                    message, version=version, from_controller=from_controller
                )
                # 3 + 1 + 2 + 1 + 2 + 1 bytes.
                size = len(package)
                self.check(package, f"{size:04x}" + text[4:])
                decoded = mut.decode_text(
                    read_one(package)[1],
                    version=version,
                    from_controller=from_controller,
                )
                self.assertEqual(decoded.text, "hi")
                self.assertEqual(decoded.level, 2)

    def test_start_and_pause(self):
        self.check(mut.encode_package(PackageType.START), "0003 53")
        self.check(mut.encode_accepted(PackageType.PAUSE, False), "0004 50 00")


class TestRoundTrips(unittest.TestCase):
    @given(
        st.lists(st.sampled_from(sorted(_VALUES)), max_size=20).flatmap(
            lambda kinds: st.tuples(
                st.just(kinds), st.tuples(*[_VALUES[k] for k in kinds])
            )
        ),
        st.integers(1, 255),
        st.sampled_from([1, 2]),
    )
    @settings(max_examples=100, deadline=None)
    def test_data(self, fields, number, version):
        kinds, values = fields
        names = [f"field_{i}" for i in range(len(kinds))]
        dut = mut.Recipe(names, kinds, number)
        self.assertEqual(dut.size, sum(_SIZES[kind] for kind in kinds))
        package = dut.encode(values, version=version)
        kind, payload = read_one(package)
        self.assertEqual(kind, PackageType.DATA_PACKAGE)
        self.assertEqual(dut.decode(payload, version=version), values)
        for wrong in (payload[1:], payload + b"x"):
            if wrong == payload:
                continue
            with self.assertRaises(RtdeError):
                dut.decode(wrong, version=version)

    @given(
        st.text(st.characters(codec="ascii"), max_size=255),
        st.text(st.characters(codec="ascii"), max_size=255),
        st.integers(0, 255),
    )
    @settings(max_examples=50, deadline=None)
    def test_text(self, text, source, level):
        message = mut.TextMessage(text, source, level)
        _, payload = read_one(mut.encode_text(message))
        self.assertEqual(mut.decode_text(payload), message)

    @given(
        st.lists(st.sampled_from(sorted(OUTPUT_TYPES)), max_size=30),
        st.floats(1, 500),
    )
    @settings(max_examples=50, deadline=None)
    def test_setup(self, names, frequency):
        _, payload = read_one(
            mut.encode_output_setup(names, frequency=frequency)
        )
        self.assertEqual(
            mut.decode_output_setup(payload), (frequency, tuple(names))
        )
        # The comma that some clients leave at the end is not a field.
        self.assertEqual(
            mut.decode_output_setup(payload + b","), (frequency, tuple(names))
        )
        setup = mut.Setup(7, tuple(OUTPUT_TYPES[name] for name in names))
        _, payload = read_one(mut.encode_output_setup_reply(setup))
        self.assertEqual(mut.decode_output_setup_reply(payload), setup)


class TestRecipe(unittest.TestCase):
    def test_every_known_field_has_a_known_type(self):
        for table in (INPUT_TYPES, OUTPUT_TYPES):
            mut.Recipe(tuple(table), tuple(table.values()), 1)

    def test_refuses(self):
        with self.assertRaisesRegex(RtdeError, "2 names, but 1"):
            mut.Recipe("ab", ("DOUBLE",), 1)
        with self.assertRaisesRegex(RtdeError, "unknown type: NOT_FOUND"):
            mut.Recipe("ab", ("DOUBLE", mut.NOT_FOUND), 1)
        dut = mut.Recipe("ab", ("UINT8", "VECTOR3D"), 1)
        for values in ((1,), (256, (0, 0, 0)), (1, (0, 0)), (1, 5), ("x", ())):
            with self.subTest(values=values), self.assertRaises(RtdeError):
                dut.encode(values)

    def test_recipe_number(self):
        dut = mut.Recipe("a", ("UINT8",), 1)
        _, payload = read_one(mut.Recipe("a", ("UINT8",), 0).encode((5,)))
        with self.assertRaisesRegex(RtdeError, "recipe 0: expected 1"):
            dut.decode(payload)
        self.assertEqual(dut.decode(payload, any_id=True), (5,))

    def test_any_byte_but_zero_is_true(self):
        dut = mut.Recipe("a", ("BOOL",), 1)
        self.assertEqual(dut.decode(b"\x01\x07"), (True,))

    def test_names(self):
        for names in (("a", ""), ("a,b",), ("ä",), ("x" * 2049,)):
            with self.subTest(names=names), self.assertRaises(RtdeError):
                mut.encode_input_setup(names)
        self.assertEqual(mut.decode_input_setup(b",a,, b,"), ("a", "b"))

    def test_package_size(self):
        with self.assertRaises(RtdeError):
            mut.encode_package(1, bytes(65533))
        self.assertEqual(len(mut.encode_package(1, bytes(65532))), 65535)


class TestPackageReader(unittest.TestCase):
    @given(
        st.lists(
            st.tuples(st.integers(0, 255), st.binary(max_size=50)), max_size=8
        ),
        st.data(),
    )
    @settings(max_examples=100, deadline=None)
    def test_cuts_do_not_matter(self, packages, data):
        stream = b"".join(mut.encode_package(*p) for p in packages)
        cuts = data.draw(
            st.lists(st.integers(0, len(stream)), max_size=10).map(sorted)
        )
        dut = mut.PackageReader()
        found = []
        for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
            found += dut.feed(stream[start:end])
        self.assertEqual(found, packages)

    def test_size_below_header_is_fatal(self):
        dut = mut.PackageReader()
        good = mut.encode_package(80)
        # Good packages before it are not lost.
        self.assertEqual(dut.feed(good + b"\x00\x02U"), [(80, b"")])
        with self.assertRaisesRegex(RtdeError, "size 2"):
            dut.check()
        self.assertEqual(dut.feed(good), [])
        with self.assertRaisesRegex(RtdeError, "size 2"):
            dut.check()

    @given(st.lists(st.binary(max_size=300), max_size=5))
    @settings(max_examples=100, deadline=None)
    def test_any_bytes(self, chunks):
        dut = mut.PackageReader()
        for chunk in chunks:
            for _, payload in dut.feed(chunk):
                for decode in _DECODERS:
                    with contextlib.suppress(RtdeError):
                        decode(payload)
        with contextlib.suppress(RtdeError):
            dut.check()


class TestFuzz(unittest.TestCase):
    """A hundred thousand damaged streams.

    RTDE has no checksum: it trusts TCP. So a damaged package of the right size
    and recipe cannot be distinguished from a good one and is accepted. Any
    other is rejected, and only RtdeError is ever raised.
    """

    def test_damaged_streams(self):
        random = np.random.default_rng(4)
        recipe = mut.Recipe(
            ("t", "q", "mode", "bits"),
            ("DOUBLE", "VECTOR6D", "INT32", "UINT64"),
            1,
        )
        stream = b"".join(
            (
                mut.encode_accepted(PackageType.START, True),
                recipe.encode((1.0, range(6), 7, 255)),
                mut.encode_text(mut.TextMessage("hello", "me")),
                recipe.encode((1.008, range(6), 7, 255)),
            )
        )
        count, size = 100_000, len(stream)
        # Up to four bytes of each are overwritten; then its end or its
        # beginning is cut off.
        where = random.integers(0, size, (count, 4))
        what = random.integers(0, 256, (count, 4), dtype=np.uint8)
        streams = np.tile(np.frombuffer(stream, np.uint8), (count, 1))
        streams[np.arange(count)[:, None], where] = what
        start = np.where(random.random(count) < 0.3, where[:, 0], 0)
        end = np.where(random.random(count) < 0.3, where[:, 1], size)
        decoders = {
            PackageType.START: mut.decode_accepted,
            PackageType.TEXT_MESSAGE: mut.decode_text,
            PackageType.DATA_PACKAGE: recipe.decode,
        }
        accepted = refused = fatal = 0
        for i in range(count):
            reader = mut.PackageReader()
            packages = reader.feed(streams[i, start[i] : end[i]].tobytes())
            try:
                reader.check()
            except RtdeError:
                fatal += 1
            for kind, payload in packages:
                decode = decoders.get(kind)
                if decode is None:
                    continue
                try:
                    decode(payload)
                except RtdeError:
                    refused += 1
                    continue
                accepted += 1
                if kind == PackageType.DATA_PACKAGE:
                    self.assertEqual(len(payload), 1 + recipe.size)
                    self.assertEqual(payload[0], 1)
        self.assertGreater(accepted, count)
        self.assertGreater(refused, 1000)
        self.assertGreater(fatal, 1000)

    def test_not_a_number_survives_as_such(self):
        recipe = mut.Recipe("a", ("DOUBLE",), 1)
        payload = b"\x01" + struct.pack(">d", math.nan)
        self.assertTrue(math.isnan(recipe.decode(payload)[0]))
