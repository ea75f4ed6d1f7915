import os

import pytest

import tofssm_drake.user_files as mut


def test_read_file(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"12345")
    assert mut.read_file(path, most=5) == b"12345"
    with pytest.raises(OSError) as info:
        mut.read_file(path, most=4)
    assert info.value.strerror == "it is larger than 4e-06 MB"


def test_pipe_and_device_are_not_read(tmp_path):
    """A pipe without a writer would be waited for, a device never ends."""
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero", "/dev/null"):
        with pytest.raises(OSError, match="regular file") as info:
            mut.read_file(path, most=10)
        assert info.value.strerror == "it is not a regular file"


def test_folder_and_nothing(tmp_path):
    with pytest.raises(IsADirectoryError):
        mut.read_file(tmp_path, most=10)
    with pytest.raises(FileNotFoundError):
        mut.read_file(tmp_path / "nothing", most=10)


def test_decode_json():
    assert mut.decode_json('{"a": [1]}') == {"a": [1]}
    deep = "[" * 100_000 + "]" * 100_000
    for bad in ("{", deep, b"\xff\xff", '{"a":' * 50_000):
        with pytest.raises(ValueError):
            mut.decode_json(bad)
