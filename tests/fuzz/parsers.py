"""Every parser of what a stranger may send or write, as a function of bytes.

Each one returns if the bytes are good and raises nothing but the error that
its documentation names. `SEEDS` has good inputs, and bad ones that once did
harm.
"""

import base64
from collections.abc import Callable
import contextlib
import io
import json
from pathlib import Path
import struct
import tempfile

from bvh_writer import write_bvh
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
import numpy as np

from tofssm_drake.diagrams.scenario import (
    Scenario,
    change_scenario,
    dump_scenario,
    load_scenario,
)
from tofssm_drake.errors import UserError
from tofssm_drake.messages import RingScan, RobotReport, SliderCommand
from tofssm_drake.people.bvh_file import read_bvh
from tofssm_drake.raycast.gltf_file import read_gltf
from tofssm_drake.raycast.gltf_references import check_references
from tofssm_drake.raycast.obj_file import read_obj
from tofssm_drake.raycast.vtk_file import check_vtk
from tofssm_drake.recording.run_record import (
    RecordedTick,
    RunReader,
    RunRecorder,
)
from tofssm_drake.ringlink.ring_frame import (
    FrameError,
    FrameStream,
    RingFrame,
    decode_frame,
    encode_frame,
    encode_serial,
)
import tofssm_drake.rtde.rtde_protocol as rtde

_FRAME = RingFrame(
    ring=1,
    flags=0,
    sequence=3,
    time_us=24_000,
    mm=np.array([400, 1200], np.uint16),
    status=np.zeros(2, np.uint8),
    age_ms=np.array([0, 3], np.uint8),
    period_ms=np.array([24, 24], np.uint8),
)
_TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
_VTK = (
    b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\n"
    b"POINTS 4 double\n0 0 0 1 0 0 0 1 0 0 0 1\n"
    b"CELLS 1 5\n4 0 1 2 3\nCELL_TYPES 1\n10\n"
)
_BINARY_VTK = (
    _VTK[: _VTK.index(b"0 0 0")].replace(b"ASCII", b"BINARY")
    + np.array([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1], ">f8").tobytes()
    + b"\nCELLS 1 5\n"
    + np.array([4, 0, 1, 2, 3], ">i4").tobytes()
    + b"\nCELL_TYPES 1\n"
    + np.array([10], ">i4").tobytes()
)
_MCAP = b"\x89MCAP0\r\n"
_DEFAULT = load_scenario()


@contextlib.contextmanager
def _open_file(data, suffix):
    """Yields the path of a file in memory, where the system has such."""
    folder = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.NamedTemporaryFile(suffix=suffix, dir=folder) as file:
        file.write(data)
        file.flush()
        yield Path(file.name)


def read_ring_frame(data: bytes) -> None:
    try:
        frame = decode_frame(data)
    except FrameError:
        return
    # What is accepted is a whole frame, with no other reading.
    assert encode_frame(frame) == data


def read_serial_line(data: bytes) -> None:
    whole, parts = FrameStream(), FrameStream()
    frames = whole.push(data)
    middle = len(data) // 2
    split = [*parts.push(data[:middle]), *parts.push(data[middle:])]
    assert list(map(encode_frame, frames)) == list(map(encode_frame, split))


def read_rtde(data: bytes) -> None:
    reader = rtde.PackageReader()
    recipe = rtde.Recipe(("a", "b"), ("DOUBLE", "VECTOR6D"), 1)
    try:
        for kind, payload in reader.feed(data):
            _decode_package(kind, payload, recipe)
        reader.check()
    except rtde.RtdeError:
        pass


def _decode_package(kind, payload, recipe):
    for decode in (
        rtde.decode_version_request,
        rtde.decode_accepted,
        rtde.decode_controller_version,
        rtde.decode_output_setup,
        rtde.decode_output_setup_reply,
        rtde.decode_input_setup,
        rtde.decode_input_setup_reply,
        rtde.decode_text,
        recipe.decode,
    ):
        try:
            decode(payload)
        except rtde.RtdeError:
            continue


def read_scenario(data: bytes) -> None:
    text = data.decode("utf-8", errors="replace")
    try:
        scenario = change_scenario(_DEFAULT, text, source="text")
    except UserError as error:
        assert "\n" not in str(error)
        return
    # What is accepted is as it is written, and accepted again.
    values = dump_scenario(scenario)
    again = change_scenario(Scenario(), json.dumps(values), source="text")
    assert dump_scenario(again) == values


def read_recording(data: bytes) -> None:
    with _open_file(data, ".bvh") as path:
        try:
            recording = read_bvh(path)
        except UserError as error:
            assert "\n" not in str(error)
            return
    assert np.isfinite(recording.frames).all()


def read_obj_mesh(data: bytes) -> None:
    _check_mesh(lambda: read_obj(data))


def read_gltf_mesh(data: bytes) -> None:
    def load(uri):
        raise OSError(f"there is no {uri}")

    def read():
        mesh = read_gltf(data, load)
        check_references(json.loads(data), load)
        return mesh

    _check_mesh(read)


def _check_mesh(read):
    try:
        vertices, faces = read()
    except (ValueError, LookupError, AttributeError, TypeError, OSError):
        return
    used = vertices[faces]
    assert faces.size == 0 or faces.min() >= 0
    assert np.isfinite(used).all()


def read_vtk_mesh(data: bytes) -> None:
    try:
        check_vtk(data)
    except ValueError:
        pass


def read_record(data: bytes) -> None:
    with _open_file(data, ".mcap") as path:
        try:
            ticks = list(RunReader(path).read_ticks())
        except UserError as error:
            assert "\n" not in str(error)
            return
    times = [tick.time for tick in ticks]
    assert times == sorted(times)
    assert np.isfinite(times).all()


PARSERS: dict[str, Callable[[bytes], None]] = {
    "ring_frame": read_ring_frame,
    "serial_line": read_serial_line,
    "rtde": read_rtde,
    "scenario": read_scenario,
    "bvh": read_recording,
    "obj": read_obj_mesh,
    "gltf": read_gltf_mesh,
    "vtk": read_vtk_mesh,
    "record": read_record,
}


def make_gltf(uri: str) -> bytes:
    """Returns a glTF file of one triangle, whose buffer is at a uri."""
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "accessors": [
                {
                    "bufferView": 0,
                    "componentType": 5126,
                    "count": 3,
                    "type": "VEC3",
                }
            ],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "buffers": [{"uri": uri, "byteLength": 36}],
        }
    ).encode()


def _make_record():
    """Returns a record of two ticks, without what its reader skips."""
    run = {"links": ["a"], "law": {"states": ["stop"], "signals": {}}}
    scan = RingScan(
        sequence=1,
        sensor_time=np.zeros(1),
        distance=np.ones(1),
        status=np.zeros(1, np.uint8),
    )
    small = io.BytesIO()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with RunRecorder(path, run) as recorder:
            recorder.add_tick(_make_tick(0.0, scan))
            recorder.add_tick(_make_tick(0.008, scan))
        _copy_messages(path.read_bytes(), small, ("/run", "/tick"))
    return small.getvalue()


def _make_tick(time, scan):
    return RecordedTick(
        time=time,
        clock_offset=0.0,
        report=RobotReport(sequence=1, time=time),
        scans=(scan,),
        command=SliderCommand(),
        state={
            "robot_state": 0,
            "ring_states": [0],
            "distance": [1.0],
            "speed_fraction": 0.0,
            "reason": "",
            "problem": [""],
            "sample_time": [0.0],
            "deciding_link": "a",
            "slider_reason": "",
            "slider_phase": 0,
            "signals": {},
            "target": 0.0,
        },
        busy=0.001,
    )


def _copy_messages(record, to, topics):
    writer = Writer(
        to,
        compression=CompressionType.NONE,
        index_types=IndexType.NONE,
        use_chunking=False,
        repeat_channels=False,
        use_statistics=False,
        use_summary_offsets=False,
        enable_data_crcs=False,
    )
    writer.start(library="tofssm_drake")
    channels = {
        topic: writer.register_channel(topic, "json", 0) for topic in topics
    }
    reader = make_reader(io.BytesIO(record))
    for _, channel, message in reader.iter_messages(topics):
        writer.add_message(channels[channel.topic], 0, message.data, 0)
    writer.finish()


def _make_bvh():
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "walk.bvh"
        write_bvh(path, fps=30.0, duration=0.5)
        return path.read_bytes()


DATA_URI = (
    "data:application/octet-stream;base64,"
    + base64.b64encode(
        np.array([0, 0, 0, 1, 0, 0, 0, 1, 0], np.float32).tobytes()
    ).decode()
)

_RECORD = _make_record()

SEEDS: dict[str, list[bytes]] = {
    "ring_frame": [encode_frame(_FRAME)],
    "serial_line": [b"\0" + 3 * encode_serial(_FRAME)],
    "rtde": [
        rtde.encode_version_request(2) + rtde.encode_accepted(86, True),
        rtde.encode_input_setup(("a", "b")),
        rtde.encode_output_setup(("a", "b"), frequency=125.0),
        rtde.Recipe(("a", "b"), ("DOUBLE", "VECTOR6D"), 1).encode(
            (1.0, (0.0,) * 6)
        ),
    ],
    "scenario": [
        b"{random_seed: 3, law: {C_dC: 0.4}}",
        b"people: {visitor: null}\nsensors: {base: {count: 16}}\n",
        b"{a: " * 1500,
        b"x0: &x0 {a: 1}\n"
        + b"".join(
            b"x%d: &x%d {<<: [*x%d, *x%d]}\n" % (i, i, i - 1, i - 1)
            for i in range(1, 28)
        ),
    ],
    "bvh": [_make_bvh()],
    "obj": [
        _TRIANGLE + b"f 1 2 3\nf 1/1 2/2 -1\n",
        _TRIANGLE + b"f 1 2 99999999999\n",
        _TRIANGLE + b"f 1 2 -9\n",
    ],
    "gltf": [
        make_gltf(DATA_URI),
        make_gltf("/dev/zero"),
        make_gltf(DATA_URI).replace(
            b'"POSITION": 0}', b'"POSITION": 0}, "material": 99'
        ),
        make_gltf(DATA_URI)[:-1] + b', "images": [{"uri": "/dev/zero"}]}',
        b"[" * 100_000,
    ],
    "vtk": [
        _VTK,
        _VTK.replace(b"1 2 3\nCELL_", b"1 2 99\nCELL_"),
        _VTK[: _VTK.index(b" 1 5")],
        _VTK.replace(b"CELLS 1 5", b"CELLS 1 99999999999"),
        _BINARY_VTK,
        _BINARY_VTK.replace(b"POINTS 4", b"POINTS 1000000000"),
        _BINARY_VTK[:-20],
    ],
    "record": [
        _RECORD,
        # The name of its library has 738 MB.
        _RECORD.replace(b"\x0c\0\0\0tof", b"\x0c\0\0\x2ctof", 1),
        # A message that is shorter than its own numbers.
        _MCAP + b"\5" + struct.pack("<Q", 1) + bytes(100),
    ],
}
