#!/usr/bin/env python3
"""Writes a small recording as the contract has it, with the Python `mcap` package; prints what is in it.

Images of a moving pattern with a known disparity, both calibrations, telemetry as raw MAVLink frames,
a spectrometer. The same arguments give the same bytes. --truncate and --corrupt make broken ones.
"""

import argparse
import json
import os

os.environ["MAVLINK20"] = "1"

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mav_autopilot import quaternion
from mavclient import mavlink, print_json
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer

DISPARITY_PX = 6
LAG_NS = 5_000_000  # from mid-exposure to arrival
BOOT_AGE_NS = 100_000_000_000


class Recording:
    def __init__(self, args, stream):
        self.args = args
        self.writer = Writer(stream, compression=CompressionType[args.compression.upper()])
        self.mcap = self.writer._writer  # for channels that are not protobuf
        self.mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.counts = {}
        self.raw_channel = self.mcap.register_channel("/mavlink/raw", "mavlink", 0)
        self.spectrum_channel = self.mcap.register_channel("/spectrometer", "json", 0)

    def message(self, topic, message, log_time, publish_time):
        self.writer.write_message(topic, message, log_time, publish_time)
        self.count(topic)

    def raw(self, message, at):
        self.mcap.add_message(self.raw_channel, at, bytes(message.pack(self.mav)), at)
        self.count("/mavlink/raw")

    def spectrum(self, at):
        wavelengths = [700.0 + 2 * i for i in range(100)]
        line = [100 + 900 * np.exp(-(((w - 766.5) / 3) ** 2)) for w in wavelengths]  # potassium
        data = json.dumps({"wavelengths_nm": wavelengths, "intensity": [round(float(v), 3) for v in line]})
        self.mcap.add_message(self.spectrum_channel, at + LAG_NS, data.encode(), at)
        self.count("/spectrometer")

    def count(self, topic):
        self.counts[topic] = self.counts.get(topic, 0) + 1


def calibration(args, eye, at):
    width, height = args.size
    f, cx, cy = 0.8 * width, (width - 1) / 2, (height - 1) / 2
    message = CameraCalibration(
        frame_id=f"stereo_{eye}_optical",
        width=width,
        height=height,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=[f, 0, cx, 0, f, cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[f, 0, cx, -f * args.baseline_m if eye == "right" else 0, 0, f, cy, 0, 0, 0, 1, 0],
    )
    message.timestamp.FromNanoseconds(at)
    return message


def picture(args, eye, index):
    """A random texture that slides two pixels a frame; the right eye sees it DISPARITY_PX to the left."""
    width, height = args.size
    texture = np.random.default_rng(1).integers(0, 256, (height, width + 256, 3), dtype=np.uint8)
    texture = cv2.GaussianBlur(texture, (5, 5), 1.2)
    begin = 2 * index % 128 + (DISPARITY_PX if eye == "right" else 0)
    return np.ascontiguousarray(texture[:, begin : begin + width])


def image(args, eye, index, at):
    _, data = cv2.imencode(f".{args.format}", picture(args, eye, index))
    data = data.tobytes()
    if args.broken_image == index:
        data = data[: len(data) // 2]
    message = CompressedImage(frame_id=f"stereo_{eye}_optical", format=args.format, data=data)
    message.timestamp.FromNanoseconds(at)
    return message


def telemetry(at, boot_ns):
    """What one moment of a hover looks like on the wire."""
    ms = boot_ns // 1_000_000
    yield mavlink.MAVLink_attitude_quaternion_message(ms, *quaternion(0.0, 0.0, np.pi / 2), 0, 0, 0)
    yield mavlink.MAVLink_global_position_int_message(
        ms, 314094222, 1191120167, 22_000, 12_000, 0, 0, 0, 9000
    )
    yield mavlink.MAVLink_gps_raw_int_message(
        boot_ns // 1000, 3, 314094222, 1191120167, 22_000, 80, 120, 0, 9000, 14, 27_000, 1200, 2000, 200, 0, 0
    )
    yield mavlink.MAVLink_system_time_message(at // 1000, ms)
    # A reply: the autopilot's boot clock in tc1, our service clock in ts1, half a millisecond each way.
    yield mavlink.MAVLink_timesync_message(boot_ns - 500_000, at - 1_000_000)
    yield mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)


def write(args):
    period = round(1e9 / args.rate_hz)
    with open(args.file, "wb") as stream:
        recording = Recording(args, stream)
        for index in range(args.pairs):
            mid = args.start_unix_ns + index * period
            arrival = mid + LAG_NS
            for message in telemetry(mid - period // 4, BOOT_AGE_NS + index * period - period // 4):
                recording.raw(message, mid - period // 4)
            for eye in ("left", "right"):
                if index == 0:
                    message = calibration(args, eye, mid)
                    recording.message(f"/stereo/{eye}/calibration", message, arrival, mid)
                if eye == "right" and args.dead_right_eye:
                    continue
                recording.message(f"/stereo/{eye}/image", image(args, eye, index, mid), arrival, mid)
            recording.spectrum(mid)
        recording.writer.finish()
    return {
        "file": args.file,
        "bytes": spoil(args),
        "counts": recording.counts,
        "first_image_ns": args.start_unix_ns,
        "last_image_ns": args.start_unix_ns + (args.pairs - 1) * period,
        "disparity_px": DISPARITY_PX,
        "size": args.size,
    }


def spoil(args):
    """Cuts or flips what was written, if so asked; the size that remains."""
    with open(args.file, "r+b") as stream:
        size = stream.seek(0, os.SEEK_END)
        if args.truncate:
            size = int(size * args.truncate)
            stream.truncate(size)
        if args.corrupt:
            stream.seek(int(size * args.corrupt))
            byte = stream.read(1)
            stream.seek(-1, os.SEEK_CUR)
            stream.write(bytes([byte[0] ^ 0xFF]))
    return size


def size(text):
    width, height = text.split("x")
    return int(width), int(height)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("file")
    add("--pairs", type=int, default=5)
    add("--rate-hz", type=float, default=10.0)
    add("--size", type=size, default=(160, 90), metavar="WxH")
    add("--format", choices=["jpeg", "png"], default="jpeg")
    add("--baseline-m", type=float, default=0.075)
    add("--start-unix-ns", type=int, default=1_795_000_000_000_000_000)
    add("--compression", choices=["none", "lz4", "zstd"], default="zstd")
    add("--dead-right-eye", action="store_true", help="no right images")
    add("--broken-image", type=int, metavar="N", help="pair N holds half of each image")
    add("--truncate", type=float, metavar="SHARE", help="keep only this share of the file")
    add("--corrupt", type=float, metavar="SHARE", help="flip the byte at this share of the file")
    print_json(write(parser.parse_args()))


if __name__ == "__main__":
    main()
