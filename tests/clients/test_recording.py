"""The recording that the Python package writes is what it reads, and damage is found."""

import pytest
from conftest import run


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "a.mcap"
    written = run("mcap_write", path)
    read = run("mcap_check", path)
    assert read["problems"] == []
    assert {name: topic["count"] for name, topic in read["topics"].items()} == written["counts"]
    left = read["topics"]["/stereo/left/image"]
    assert left["schema"] == "foxglove.CompressedImage"
    assert left["message_encoding"] == "protobuf" and left["schema_encoding"] == "protobuf"
    assert left["first_publish_time"] == written["first_image_ns"]
    assert left["last_publish_time"] == written["last_image_ns"]
    assert left["sizes"] == {"160x90": 5}
    raw = read["topics"]["/mavlink/raw"]
    assert raw["message_encoding"] == "mavlink" and raw["schema"] is None
    assert raw["messages"]["ATTITUDE_QUATERNION"] == 5
    assert read["pairs"] == {"count": 5, "left": 5, "right": 5, "greatest_skew_ms": 0.0}
    assert read["summary"]["messages"] == sum(written["counts"].values())
    assert read["records"]["chunks_with_crc"] >= 1


@pytest.mark.parametrize("options", [[], ["--format", "png"], ["--compression", "none"]])
def test_same_arguments_same_bytes(tmp_path, options):
    for name in "ab":
        run("mcap_write", tmp_path / name, *options)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("damage", [["--truncate", 0.6], ["--corrupt", 0.3], ["--broken-image", 2]])
def test_damage_is_found(tmp_path, damage):
    path = tmp_path / "bad.mcap"
    run("mcap_write", path, "--compression", "none", "--format", "png", *damage)
    assert run("mcap_check", path, rc=1)["problems"]


def test_a_dead_eye_makes_no_pairs(tmp_path):
    path = tmp_path / "one.mcap"
    run("mcap_write", path, "--dead-right-eye")
    assert run("mcap_check", path)["pairs"] == {"count": 0, "left": 5, "right": 0}
