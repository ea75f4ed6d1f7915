import dataclasses as dc
import json
import math
from pathlib import Path
import resource
import tempfile
import time
import unittest
from unittest import mock

import jsonschema
from mcap.reader import make_reader
from mcap.writer import Writer
import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.messages import RingScan, RobotReport, SliderCommand
import tofssm_drake.recording.run_record as mut
from tofssm_drake.rtde.arm_obedience import ArmConfig

RUN = {
    "links": ["base", "elbow", "tool"],
    "law": {
        "states": ["stop", "reduced", "normal"],
        "signals": {"margin": {"unit": "m"}},
    },
}


def make_tick(k, scans):
    return mut.RecordedTick(
        time=0.008 * k,
        clock_offset=-100.0 / 3.0,
        report=RobotReport(
            sequence=k, session=0, time=1e5 / 3 + k, timestamp=k / 3
        ),
        scans=scans,
        command=SliderCommand(sequence=k, speed_fraction=1 / 3, heartbeat=k),
        state={
            "robot_state": 1,
            "ring_states": [1, 2, 1],
            "reason": 'a "NaN" is not a number',
            "target": 1 / 3,
            "deciding_link": "base",
            "signals": {"margin": [1 / 3, np.inf, 2.0]},
            "speed_fraction": 1 / 3,
            "slider_phase": 1,
            "slider_reason": "",
            "distance": [1 / 3, np.inf, 2.0],
            "problem": ["", "", "sensor 3 is frozen"],
            "sample_time": [0.0, -np.inf, 0.0],
        },
        sent=1e5 / 3 + k + 0.0005 if k else np.nan,
        busy=1.5,
    )


def make_scan(k):
    return RingScan(
        sequence=k,
        time=k / 7,
        sensor_time=np.array([k / 9, -np.inf]),
        distance=np.array([np.inf, np.nan]),
        status=np.array([0, 255], dtype=np.uint8),
        problem="" if k % 2 else f"period {k} ms, NaN lost",
    )


class TestJson(unittest.TestCase):
    def test_numbers_that_are_none_are_replaced_outside_strings(self):
        for text in ("NaN", '"NaN,', "\\", '\\"Infinity\\', 'a "b" NaN\n'):
            with self.subTest(text=text):
                values = {text: [text, np.nan, np.inf, -np.inf, 1.5]}
                self.assertEqual(
                    json.loads(mut.encode_json(values)),
                    {text: [text, None, np.inf, -np.inf, 1.5]},
                )


class TestRunRecord(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.path = Path(folder.name) / "run.mcap"

    def write(self, count=5):
        ticks = []
        with mut.RunRecorder(self.path, RUN | {"what": "test"}) as recorder:
            scan = make_scan(0)
            for k in range(count):
                if k % 2 == 0:
                    scan = make_scan(k)
                ticks.append(make_tick(k, (scan, scan)))
                recorder.add_robot_bytes(0.0, k == 0, bytes([k]))
                recorder.add_ring_bytes(0.0, "udp", b"frame")
                recorder.add_tick(ticks[-1])
        return ticks

    def assert_equal(self, a, b):
        for name, value in vars(a).items():
            other = vars(b)[name]
            if isinstance(value, np.ndarray):
                self.assertEqual(value.dtype, other.dtype)
            np.testing.assert_array_equal(value, other)

    def test_round_trip_to_the_last_bit(self):
        ticks = self.write()
        reader = mut.RunReader(self.path)
        self.assertEqual(reader.run["what"], "test")
        read = list(reader.read_ticks())
        self.assertEqual(len(read), len(ticks))
        for was, now in zip(ticks, read, strict=True):
            self.assertEqual(
                (was.time, was.clock_offset, was.state, was.busy),
                (now.time, now.clock_offset, now.state, now.busy),
            )
            np.testing.assert_array_equal(was.sent, now.sent)
            self.assert_equal(was.report, now.report)
            self.assert_equal(was.command, now.command)
            for a, b in zip(was.scans, now.scans, strict=True):
                self.assert_equal(a, b)

    def test_scans_of_before_there_were_problems(self):
        """An older record has none: nothing was known to be wrong."""
        scan = make_scan(0)
        before = {n: v for n, v in vars(scan).items() if n != "problem"}
        with (
            mock.patch.object(mut, "vars", create=True) as plain,
            mut.RunRecorder(self.path, RUN) as recorder,
        ):
            plain.side_effect = lambda value: (
                before if value is scan else value.__dict__
            )
            recorder.add_tick(make_tick(0, (scan, scan)))
        (_, message) = self.read_messages("/tick")[0]
        self.assertNotIn("problem", json.loads(message.data)["scans"][0])
        (tick,) = mut.RunReader(self.path).read_ticks()
        self.assertEqual(tick.scans[0].problem, "")
        np.testing.assert_array_equal(
            tick.scans[0].sensor_time, scan.sensor_time
        )

    def test_scans_that_an_older_record_took_early(self):
        """They are not written again among the tick's scans."""
        a, b = map(make_scan, range(2))
        plain = mut._make_plain

        def make_plain(value):
            values = plain(value)
            if value is late:
                values["early_scans"] = [{"ring": 0, **plain(b)}]
            return values

        late = make_tick(1, (a, a))
        with (
            mock.patch.object(mut, "_make_plain", make_plain),
            mut.RunRecorder(self.path, RUN) as recorder,
        ):
            recorder.add_tick(make_tick(0, (a, a)))
            recorder.add_tick(late)
        _, tick = mut.RunReader(self.path).read_ticks()
        self.assert_equal(tick.scans[0], b)
        self.assert_equal(tick.scans[1], a)

    def test_a_file_that_ends_anywhere_is_read_so_far(self):
        self.write(50)
        whole = self.path.read_bytes()
        counts = []
        for size in range(len(whole) // 2, len(whole), 997):
            self.path.write_bytes(whole[:size])
            counts.append(len(list(mut.RunReader(self.path).read_ticks())))
        self.assertEqual(counts, sorted(counts))
        self.assertGreater(counts[0], 5)
        self.assertLess(counts[0], 50)

    def read_all(self):
        reader = mut.RunReader(self.path)
        count = len(list(reader.read_ticks()))
        return count, reader.is_damaged, reader.problem

    def test_reports_whether_it_is_whole(self):
        self.write(50)
        self.assertEqual(self.read_all(), (50, False, ""))
        whole = self.path.read_bytes()
        for size in range(len(whole) // 2, len(whole) - 1, 997):
            self.path.write_bytes(whole[:size])
            count, is_damaged, problem = self.read_all()
            self.assertFalse(is_damaged, problem)
            self.assertIn(f"within a record, at byte {size}", problem)
            if count < 50:
                time_ = 0.008 * (count - 1)
                self.assertIn(f"after the tick at {time_:.3f} s", problem)

    def test_reports_where_it_is_damaged(self):
        self.write(50)
        whole = self.path.read_bytes()
        middle = whole.index(b'"sequence":25,')
        for changed, ticks in (
            # One bit; not JSON; not a tick; not MCAP.
            (whole.replace(b'"time":0.2', b'"time":0.3', 1), 50),
            (whole[:middle] + b"}" * 9 + whole[middle + 9 :], 25),
            (whole.replace(b'"report":{', b'"reporT":{', 1), 0),
            (whole[:middle] + bytes(9999) + whole[middle + 9999 :], 25),
            # Something is missing in between.
            (whole[:middle] + whole[middle + 5000 :], 25),
        ):
            self.assertNotEqual(changed, whole)
            self.path.write_bytes(changed)
            count, is_damaged, problem = self.read_all()
            self.assertTrue(is_damaged)
            self.assertNotEqual(problem, "")
            self.assertEqual(count, ticks, problem)

    def test_others_can_read_it(self):
        self.write()
        with self.path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            counts = {}
            for _, channel, message in reader.iter_messages():
                counts[channel.topic] = counts.get(channel.topic, 0) + 1
                if channel.message_encoding == "json":
                    # Strict: invalid JSON does not pass.
                    json.loads(message.data, parse_constant=self.fail)
        self.assertEqual(
            counts,
            {
                "/run": 1,
                "/tick": 5,
                "/monitor": 5,
                "/robot/received": 4,
                "/robot/sent": 1,
                "/rings/received": 5,
            },
        )

    def test_a_run_that_never_begins_leaves_what_was_there(self):
        with mut.RunRecorder(self.path) as recorder:
            recorder.add_robot_bytes(0.0, False, b"too late")
        self.assertFalse(self.path.exists())
        self.path.write_bytes(b"of an earlier run")
        with mut.RunRecorder(self.path) as recorder:
            recorder.add_robot_bytes(0.0, False, b"too late")
        self.assertEqual(self.path.read_bytes(), b"of an earlier run")

    def test_what_came_before_the_run_is_written_with_it(self):
        self.path.write_bytes(b"of an earlier run")
        with mut.RunRecorder(self.path) as recorder:
            recorder.add_robot_bytes(0.0, False, b"hello")
            time.sleep(0.5)
            self.assertEqual(self.path.read_bytes(), b"of an earlier run")
            recorder.add_run(RUN)
            recorder.add_robot_bytes(0.0, False, b"once more")
        self.assertEqual(
            [m.data for _, m in self.read_messages("/robot/received")],
            [b"hello", b"once more"],
        )

    def test_a_full_disk_is_reported_by_the_next_tick(self):
        with self.assertRaisesRegex(UserError, "--record: /dev/full: cannot"):
            mut.RunRecorder(Path("/dev/full"), RUN)
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        self.addCleanup(resource.setrlimit, resource.RLIMIT_FSIZE, limits)
        scan = make_scan(0)
        with mut.RunRecorder(self.path, RUN) as recorder:
            recorder.add_tick(make_tick(0, (scan,)))
            resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
            # Callers that hand in bytes are not disturbed.
            recorder.add_robot_bytes(0.0, False, bytes(200_000))
            with self.assertRaisesRegex(UserError, "File too large"):
                for k in range(1, 1000):
                    recorder.add_tick(make_tick(k, (scan,)))
                    time.sleep(0.01)
            with self.assertRaisesRegex(UserError, "File too large"):
                recorder.add_tick(make_tick(k + 1, (scan,)))
        # What was written before can be read.
        self.assertGreater(len(list(mut.RunReader(self.path).read_ticks())), 0)

    def read_messages(self, topic):
        with self.path.open("rb") as stream:
            return [
                (schema, message)
                for schema, _, message in make_reader(stream).iter_messages(
                    topics=[topic]
                )
            ]

    def test_a_file_that_is_removed_is_reported(self):
        """It takes what is written, and then is gone with all of it."""
        recorder = mut.RunRecorder(self.path, RUN)
        self.addCleanup(recorder.close)
        self.path.unlink()
        deadline = time.monotonic() + 300.0
        with self.assertRaisesRegex(UserError, "the file was removed"):
            while time.monotonic() < deadline:
                recorder.add_tick(make_tick(0, ()))
                time.sleep(0.01)

    def test_messages_keep_to_their_schemas(self):
        nothing = dc.replace(
            make_tick(0, ()), report=RobotReport(), command=SliderCommand()
        )
        scan = RingScan(
            sequence=0,
            time=1.0,
            sensor_time=np.array([1.0, -np.inf]),
            distance=np.array([1.0, 2.0]),
            status=np.array([0, 255], dtype=np.uint8),
        )
        run = RUN | {
            "command": "tofssm hardware",
            "scenario": {"random_seed": 1},
            "virtual_rings": False,
            "dry_run": True,
            "minimum_fraction": 0.0,
            "arm": vars(ArmConfig()),
        }
        with mut.RunRecorder(self.path, run) as recorder:
            recorder.add_tick(nothing)
            recorder.add_tick(make_tick(1, (scan, scan)))
            recorder.add_tick(make_tick(2, (scan, scan)))
        for topic, count in (("/run", 1), ("/tick", 3), ("/monitor", 3)):
            messages = self.read_messages(topic)
            self.assertEqual(len(messages), count)
            for schema, message in messages:
                self.assertEqual(schema.encoding, "jsonschema")
                jsonschema.validate(
                    json.loads(message.data), json.loads(schema.data)
                )
        # They do reject something.
        broken = json.loads(message.data) | {"q": 1}
        with self.assertRaises(jsonschema.ValidationError):
            jsonschema.validate(broken, json.loads(schema.data))

    def test_what_monitor_shows(self):
        self.write(2)
        (_, first), (_, second) = self.read_messages("/monitor")
        self.assertNotIn("answer_time", json.loads(first.data))
        second = json.loads(second.data)
        self.assertAlmostEqual(second["answer_time"], 0.0005, delta=1e-9)
        self.assertEqual(second["distance"], {"base": 1 / 3, "tool": 2.0})
        self.assertEqual(
            second["ring_state"], {"base": 1, "elbow": 2, "tool": 1}
        )
        self.assertEqual(
            (second["target"], second["deciding_link"]), (1 / 3, "base")
        )
        self.assertEqual(
            second["law"], {"margin": {"base": 1 / 3, "tool": 2.0}}
        )
        self.assertNotIn("q", second)

    def test_law_without_states_or_signals(self):
        tick = make_tick(0, ())
        tick.state.update(ring_states=[], signals={})
        run = RUN | {"law": {"states": [], "signals": {}}}
        with mut.RunRecorder(self.path, run) as recorder:
            recorder.add_tick(tick)
        ((schema, message),) = self.read_messages("/monitor")
        self.assertNotIn("ring_state", json.loads(message.data))
        jsonschema.validate(json.loads(message.data), json.loads(schema.data))
        (read,) = mut.RunReader(self.path).read_ticks()
        self.assertEqual(read.state, tick.state)

    def test_other_versions(self):
        for version, is_good in ((3, False), (4, True), (5, True), (6, False)):
            with mock.patch.object(mut, "_VERSION", version):
                self.write(1)
            with self.subTest(version=version):
                if is_good:
                    mut.RunReader(self.path)
                else:
                    with self.assertRaisesRegex(UserError, "another version"):
                        mut.RunReader(self.path)

    def test_published_is_when_it_happened(self):
        """On the host's clock, from which `epoch` leads to Unix time."""
        now = time.monotonic()
        with mut.RunRecorder(self.path, RUN) as recorder:
            recorder.add_ring_bytes(now - 5.0, "udp", b"frame")
        ((_, message),) = self.read_messages("/rings/received")
        epoch = mut.RunReader(self.path).run["epoch"]
        self.assertAlmostEqual(
            message.publish_time * 1e-9 - epoch, now - 5.0, delta=1e-5
        )
        self.assertLess(abs(message.log_time * 1e-9 - time.time()), 60.0)

    def test_what_was_added_is_in_the_file_soon(self):
        with mut.RunRecorder(self.path, RUN) as recorder:
            recorder.add_tick(make_tick(0, ()))
            deadline = time.monotonic() + 300.0
            while not list(mut.RunReader(self.path).read_ticks()):
                self.assertLess(time.monotonic(), deadline)
                time.sleep(0.01)

    def test_times_that_jump_are_refused(self):
        """A replay would otherwise simulate all the time between."""
        for jump in (1e6, -1.0, math.nan, math.inf):
            with mut.RunRecorder(self.path, RUN) as recorder:
                recorder.add_tick(make_tick(0, ()))
                recorder.add_tick(dc.replace(make_tick(1, ()), time=jump))
            reader = mut.RunReader(self.path)
            with self.subTest(jump=jump):
                self.assertEqual(len(list(reader.read_ticks())), 1)
                self.assertTrue(reader.is_damaged)
                self.assertIn("an invalid tick", reader.problem)

    def test_chunks_are_not_unpacked(self):
        """A record has none; a small one may hold gigabytes."""
        with self.path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            channel = writer.register_channel(
                topic="/run", message_encoding="json", schema_id=0
            )
            writer.add_message(channel, 0, b" " * 10_000_000, 0)
            writer.finish()
        with self.assertRaisesRegex(UserError, "not a record"):
            mut.RunReader(self.path)

    def test_sizes_that_no_part_has_are_not_read(self):
        """Else the reader asks for gigabytes, or for all that follows."""
        self.write()
        data = self.path.read_bytes()
        library = b"\x0c\0\0\0tofssm_drake"
        self.assertIn(library, data)
        message = b"\x89MCAP0\r\n\5\1" + bytes(100)
        for contents in (
            data.replace(library, b"\xff\xff\xff\xfftofssm_drake", 1),
            message,
        ):
            self.path.write_bytes(contents)
            with self.assertRaisesRegex(UserError, "is not a record"):
                mut.RunReader(self.path)

    def test_values_nested_too_deep(self):
        self.write(1)
        data = self.path.read_bytes()
        with mock.patch.object(mut, "encode_json", lambda _: b"[" * 100_000):
            self.write(1)
        with self.assertRaisesRegex(UserError, "not a record"):
            mut.RunReader(self.path)
        self.assertNotEqual(data, self.path.read_bytes())

    def test_what_is_no_record(self):
        with self.assertRaisesRegex(UserError, "cannot read"):
            mut.RunReader(self.path)
        self.path.write_bytes(b"something else")
        with self.assertRaisesRegex(UserError, "not an MCAP file"):
            mut.RunReader(self.path)
        with self.assertRaisesRegex(UserError, "cannot write"):
            mut.RunRecorder(self.path.parent / "none" / "x.mcap", RUN)
