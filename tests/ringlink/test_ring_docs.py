"""Documents and firmware agree with the code."""

import pathlib
import re
import unittest

import numpy as np

from tofssm_drake.ringlink.ring_frame import (
    FLAG_BUS_ERROR,
    FLAG_ODD,
    FLAG_RESTARTED,
    FLAG_SELF_TEST,
    RingFrame,
    calc_frame_size,
    encode_frame,
    encode_serial,
)
from tofssm_drake.sensors.range_status import (
    STATUS_BUS_FAILURE,
    STATUS_NO_NEW_DATA,
)

_DOCS = pathlib.Path(__file__).parents[2] / "docs"


def read_row(name, text):
    """The numbers of each table row that begins with a name."""
    return [
        np.array([int(cell) for cell in row.split("|")])
        for row in re.findall(rf"^\| {name} \|([ \d|]+)\|$", text, re.M)
    ]


class TestDocument(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.text = (_DOCS / "ring_link.md").read_text("utf-8")

    def test_examples(self):
        headers = re.findall(
            r"^Ring (\d+), flags (\d+), sequence (\d+), time (\d+) µs:$",
            self.text,
            re.M,
        )
        blocks = [
            bytes.fromhex(block)
            for block in re.findall(r"```\n([0-9a-f \n]+)```", self.text)
        ]
        rows = [
            read_row(name, self.text)
            for name in ("mm", "status", "age", "period")
        ]
        self.assertEqual(len(headers), 2)
        self.assertEqual(len(blocks), 4)
        for i, (header, *samples) in enumerate(
            zip(headers, *rows, strict=True)
        ):
            ring, flags, sequence, time_us = map(int, header)
            mm, status, age, period = samples
            frame = RingFrame(
                ring=ring,
                flags=flags,
                sequence=sequence,
                time_us=time_us,
                mm=mm,
                status=status,
                age_ms=age,
                period_ms=period,
            )
            self.assertEqual(encode_frame(frame), blocks[2 * i])
            self.assertEqual(encode_serial(frame), blocks[2 * i + 1])

    def test_numbers(self):
        for sensors in (8, 16):
            self.assertIn(str(calc_frame_size(sensors)), self.text)
        for flag in (FLAG_RESTARTED, FLAG_ODD, FLAG_BUS_ERROR, FLAG_SELF_TEST):
            self.assertIn(f"| 0x{flag:02x} |", self.text)


class TestFirmware(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        path = _DOCS / "firmware" / "tof_ring" / "ring_frame.h"
        cls.text = path.read_text("utf-8")

    def read_array(self, name):
        (body,) = re.findall(rf"{name}\[\] = {{(.*?)}};", self.text, re.S)
        return [int(n, 0) for n in re.findall(r"0x[0-9a-f]+|\d+", body)]

    def read_constant(self, name):
        (value,) = re.findall(rf"{name} = (\w+);", self.text)
        return int(value, 0)

    def test_example_that_it_checks_itself_by(self):
        samples = np.array(self.read_array("kExampleSamples")).reshape(-1, 4)
        (arguments,) = re.findall(r"build\((\d[\d, ]+), kExample", self.text)
        ring, flags, sequence, time_us = map(int, arguments.split(","))
        frame = RingFrame(
            ring=ring,
            flags=flags,
            sequence=sequence,
            time_us=time_us,
            mm=samples[:, 0],
            status=samples[:, 1],
            age_ms=samples[:, 2],
            period_ms=samples[:, 3],
        )
        self.assertEqual(
            bytes(self.read_array("kExampleFrame")), encode_frame(frame)
        )
        self.assertEqual(
            bytes(self.read_array("kExampleLine")), encode_serial(frame)
        )

    def test_constants(self):
        for name, value in (
            ("kRestarted", FLAG_RESTARTED),
            ("kOdd", FLAG_ODD),
            ("kBusError", FLAG_BUS_ERROR),
            ("kSelfTest", FLAG_SELF_TEST),
            ("kBusFailure", STATUS_BUS_FAILURE),
            ("kNoNewData", STATUS_NO_NEW_DATA),
        ):
            self.assertEqual(self.read_constant(name), value, name)


if __name__ == "__main__":
    unittest.main()
